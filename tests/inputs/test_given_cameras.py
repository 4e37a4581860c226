"""Camera files next to the images: their order of preference, and which images they belong to."""

import json
import shutil
import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.data.sources.layout_phone import write_polycam
from tests.data.sources.layouts import room
from tests.reconstruction.conftest import SIZE
from vg2gt import io
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.data.base import DataError
from vg2gt.geometry.cameras import resize_intrinsics, unproject
from vg2gt.inputs.cameras import pictures_for
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.inputs import depth_range, load_views
from vg2gt.inputs.pictures import Picture
from vg2gt.monitor import Monitor
from vg2gt.runs.load import load_model
from vg2gt.types import Cameras

NAMES = [f"{8 + i:03d}.png" for i in range(4)]


def put_poses(folder: Path, recording: Path) -> None:
    for name in ("poses.txt", "K.txt"):
        shutil.copy(recording / name, folder / name)


def put_colmap(folder: Path, frames) -> None:
    cameras = Cameras(frames.world_to_camera[None].double(), frames.intrinsics[None].double(), SIZE)
    world = unproject(frames.depth[None].double(), cameras)[0]  # [V, H, W, 3]
    pixels = np.stack(np.meshgrid(np.arange(3, 112, 9), np.arange(3, 84, 9)), -1).reshape(-1, 2)
    points = torch.cat([view[pixels[:, 1], pixels[:, 0]] for view in world]).numpy()
    views = np.repeat(np.arange(4), len(pixels))
    sources = (np.arange(len(views)), views, np.tile(pixels, (4, 1)))
    io.write_colmap(folder / "sparse" / "0", io.colmap_from_views(cameras, NAMES, points, sources=sources))


def put_transforms(folder: Path, frames) -> None:
    lens = io.Lens.from_intrinsics(frames.intrinsics[0].double().numpy(), SIZE)
    poses = frames.world_to_camera.double().numpy()
    records = [io.TransformsFrame(f"images/{name}", pose, lens) for name, pose in zip(NAMES, poses, strict=True)]
    io.write_transforms(folder / "transforms.json", io.Transforms(tuple(records)))


def put_cameras(folder: Path, frames, names=NAMES, size=SIZE, intrinsics=None) -> None:
    k = frames.intrinsics[0].double().numpy() if intrinsics is None else intrinsics
    poses = frames.world_to_camera.double().numpy()
    cameras = [io.NamedCamera(name, size[1], size[0], k, pose) for name, pose in zip(names, poses, strict=False)]
    io.write_cameras_json(folder / "cameras.json", cameras)


def put_nvm(folder: Path, frames) -> None:
    rows = ["NVM_V3", "", str(len(NAMES)), *(f"images/{name}\t90 1 0 0 0 {i} 0 0 0 0" for i, name in enumerate(NAMES))]
    (folder / "model.nvm").write_text("\n".join([*rows, "0", ""]))


def check_cameras(pictures: list[Picture] | None, frames, kind: str) -> None:
    assert {picture.source.split(" ")[0] for picture in pictures} == {kind}
    views = load_views(pictures, SIZE, Monitor())
    assert [picture.name for picture in pictures] == ["008", "009", "010", "011"]
    assert torch.allclose(views.hints.cameras.world_to_camera[0], frames.world_to_camera, atol=1e-4)
    assert torch.allclose(views.hints.cameras.intrinsics[0], frames.intrinsics, atol=1e-3)
    assert torch.allclose(views.images, frames.images, atol=1 / 400)


@pytest.mark.parametrize("inside", [False, True])
def test_cameras_are_looked_for_in_their_order(inside: bool, folder: Path, recording: Path, frames) -> None:
    """Each kind goes before those that were put there earlier; also seen from the folder of images."""
    place = folder / "images" if inside else folder
    assert given_pictures(place) is None
    put_poses(folder, recording)
    check_cameras(given_pictures(place), frames, "poses")  # without depth, so not a recording
    for put, kind in ((put_colmap, "COLMAP"), (put_transforms, "Nerfstudio"), (put_cameras, "cameras.json")):
        put(folder, frames)
        check_cameras(given_pictures(place), frames, kind)


def test_cameras_next_to_a_folder_may_be_of_another(folder: Path, recording: Path, frames) -> None:
    for name in ("kitchen", "images_2"):
        shutil.copytree(folder / "images", folder / name)
    put_poses(folder, recording)
    for put in (None, put_colmap, put_transforms, put_cameras):
        if put is not None:
            put(folder, frames)
        assert given_pictures(folder / "kitchen") is None
        assert len(given_pictures(folder / "images") or []) == 4
        assert put is None or len(given_pictures(folder / "images_2") or []) == 4


def test_photographs_next_to_recordings_are_none_of_them(folder: Path, frames) -> None:
    for name in ("a.r3d", "b.r3d"):
        (folder / name).touch()
    assert given_pictures(folder / "images") is None
    put_colmap(folder, frames)
    assert len(given_pictures(folder / "images") or []) == 4


def test_masks_of_photographs_with_poses(folder: Path, recording: Path) -> None:
    put_poses(folder, recording)
    (folder / "masks").mkdir()
    half = np.zeros(SIZE, np.uint8)
    half[:, SIZE[1] // 2 :] = 255
    Image.fromarray(half).save(folder / "masks" / "008.png")
    mask = load_views(given_pictures(folder) or [], SIZE, Monitor()).mask
    assert mask is not None
    assert mask.mean((1, 2)).tolist() == [0.5, 1, 1, 1]


def test_depth_is_read_where_a_recording_has_it(recording: Path, tmp_path: Path, frames) -> None:
    shutil.copytree(recording, tmp_path / "room")
    put_cameras(tmp_path / "room", frames)  # goes before the recording for whoever needs no depth
    with_depth = given_pictures(tmp_path / "room", depth=True)
    check_cameras(with_depth, frames, "RGB-D")
    hints = load_views(with_depth, (56, 84), Monitor()).hints
    assert hints.depth.shape == (1, 4, 56, 84)
    assert hints.cameras.intrinsics[0, 0, 0, 0].item() == pytest.approx(0.75 * frames.intrinsics[0, 0, 0])
    check_cameras(given_pictures(tmp_path / "room"), frames, "cameras.json")


def test_some_of_the_images(folder: Path, recording: Path) -> None:
    put_poses(folder, recording)
    assert [p.name for p in given_pictures(folder, max_images=2) or []] == ["008", "011"]
    both = given_pictures([folder / "images" / "010.png", folder / "images" / "008.png"])
    assert [p.name for p in both or []] == ["010", "008"]


def test_cameras_json_of_larger_images_and_without_some(folder: Path, frames, caplog) -> None:
    double = resize_intrinsics(frames.intrinsics[0].double(), 2, 2).numpy()
    put_cameras(folder, frames, ["images/008.jpg", "009", "010.png"], (168, 224), double)
    pictures = given_pictures(folder)
    assert [p.name for p in pictures or []] == ["008", "009", "010"]
    assert "left out: 011.png" in caplog.text
    hints = load_views(pictures, SIZE, Monitor()).hints
    assert torch.allclose(hints.cameras.intrinsics[0], frames.intrinsics[:3], atol=1e-3)
    mismatch = r"008.png is 112x84 pixels, but its camera in .*cameras.json is 84x84"
    for names, size, said in ((NAMES, (84, 84), mismatch), (["a", "b"], SIZE, "names none of the 4 images")):
        put_cameras(folder, frames, names, size)
        with pytest.raises(ValueError, match=said):
            given_pictures(folder)


def test_range_of_depth_ignores_a_few_wild_points_and_needs_some() -> None:
    def picture(depths) -> Picture:
        return Picture("a", SIZE, lambda size: None, point_depths=np.asarray(depths, np.float32))  # pyright: ignore

    rows = np.linspace(2, 4, 500)
    told = depth_range([picture(rows), picture([*rows, 1e6, 1e-6])])
    assert told.tolist()[0] == pytest.approx([0.8 * 2.02, 1.4 * 3.98], rel=0.01)
    assert depth_range([picture(rows[:5])]) is None
    assert depth_range([replace(picture(rows), point_depths=None)]) is None


def choose(model, images, poses: Any = "auto", **options):
    with pictures_for(model, images, poses, **options) as pictures:
        return pictures


def test_who_gets_which_cameras(model, folder: Path, recording: Path, ready, monkeypatch) -> None:
    asked: list[int] = []

    def find(pictures, place, monitor):
        asked.append(len(pictures))
        return [replace(picture, source="sfm") for picture in pictures]

    monkeypatch.setattr("vg2gt.inputs.cameras.find_cameras", find)
    images_alone = load_model(backend="da3_tiny", device="cpu").model
    assert ({p.source for p in choose(model, folder)}, asked) == ({"sfm"}, [4])
    with pytest.raises(ValueError, match=r"no cameras next to .*room: expected cameras.json.*--poses sfm finds"):
        choose(model, folder, "given")
    put_poses(folder, recording)
    assert {p.source for p in choose(model, folder)} == {p.source for p in choose(model, folder, "given")} != {"sfm"}
    assert asked == [4]
    assert {p.source for p in choose(model, folder, "sfm", max_images=3)} == {"sfm"}
    assert asked == [4, 3]
    assert {p.source for p in choose(images_alone, folder)} == {""}
    for poses in ("given", "sfm"):
        with pytest.raises(ValueError, match="da3_tiny predicts its own cameras and accepts none"):
            choose(images_alone, folder, poses)
    with pytest.raises(ValueError, match="works from the depth and poses of a recording"):
        choose(ready.model, recording, "sfm")
    with pytest.raises(ValueError, match="choose one of auto, given, sfm"):
        choose(model, folder, "mine")
    assert asked == [4, 3]


def test_photographs_for_the_oracle_are_refused_before_any_work(photos, run_folder, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("vg2gt.runs.load.build_model", lambda *_: pytest.fail("built a model"))
    for chosen in (["--ckpt", str(run_folder)], ["backend=oracle"]):
        with pytest.raises(SystemExit, match=r"^(?!.*hints).*needs measured depth, but.*backend=da3_small"):
            reconstruct_command.main([str(photos), *chosen, "--out", str(tmp_path / "out"), "--quiet"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("needed", [False, True])
def test_a_phones_export_is_read_at_the_size_of_its_photographs(needed: bool, tmp_path: Path) -> None:
    """Its depth is coarser, and brings the photographs down where a backend needs it."""
    frames = room(2)
    write_polycam(tmp_path, frames)
    for path in (tmp_path / "kitchen" / "keyframes" / "depth").iterdir():
        with Image.open(path) as image:
            coarse = np.array(image)[::2, ::2]
        Image.fromarray(coarse).save(path)
    pictures = given_pictures([tmp_path / "kitchen"], depth=needed)
    assert [picture.size for picture in pictures] == [(15, 20) if needed else (30, 40)] * 2
    loaded = pictures[1].read((30, 40))
    assert bool(loaded.depth.any()) == needed
    torch.testing.assert_close(loaded.world_to_camera[0], frames.world_to_camera[1], atol=1e-6, rtol=0)


def test_cameras_of_3d_gaussian_splatting(folder: Path, frames, model) -> None:
    """Its ``cameras.json`` next to the images: camera to world, names without an ending."""
    entries = []
    for number, (name, pose) in enumerate(zip(NAMES, frames.world_to_camera.double().numpy(), strict=True)):
        place = np.linalg.inv(pose)
        lens = {"width": SIZE[1], "height": SIZE[0], "fx": 90.0, "fy": 91.0}
        found = {"position": place[:3, 3].tolist(), "rotation": place[:3, :3].tolist()}
        entries.append({"id": number, "img_name": Path(name).stem, **lens, **found})
    (folder / "cameras.json").write_text(json.dumps(entries))
    pictures = given_pictures(folder) or []
    assert [picture.name for picture in pictures] == [Path(name).stem for name in NAMES]
    for picture, pose in zip(pictures, frames.world_to_camera.numpy(), strict=True):
        np.testing.assert_allclose(picture.pose, pose, atol=1e-5)
        np.testing.assert_allclose(picture.intrinsics, [[90, 0, 55.5], [0, 91, 41.5], [0, 0, 1]])
    (folder / "cameras.json").write_text("[{}]")
    with pytest.raises(DataError, match=r"cameras\.json: \[0\].*--poses sfm"):
        pictures_for(model, folder).__enter__()


@pytest.mark.parametrize("place", [0.0, 5e6])
def test_cameras_at_one_place_are_refused(place: float, folder: Path, frames, model) -> None:
    """A file of poses that was never filled in: a scene of nothing but noise came out."""
    moved = frames.world_to_camera.double().clone()
    left, _, right = torch.linalg.svd(moved[:, :3, :3])
    moved[:, :3, :3] = left @ right  # exactly
    moved[:, :3, 3] = -moved[:, :3, :3].sum(-1) * place
    put_transforms(folder, replace(frames, world_to_camera=moved))
    with (
        pytest.raises(DataError, match=r"all 4 cameras of Nerfstudio .* are at one place"),
        pictures_for(model, folder),
    ):
        pass
    moved[:, 0, 3] += torch.arange(4) * max(place, 1) * 1e-6
    put_transforms(folder, replace(frames, world_to_camera=moved))
    with pictures_for(model, folder) as pictures:
        assert len(pictures) == 4


@pytest.mark.parametrize("put", [put_transforms, put_cameras, put_nvm])
def test_umlauts_as_macos_writes_them(put, folder: Path, frames) -> None:
    """Composed in the file of cameras, decomposed in names of files and of their folder."""
    put(folder, frames)
    for name in NAMES:
        (folder / "images" / name).rename(folder / "images" / unicodedata.normalize("NFD", f"Küche {name}"))
    file = next(each for each in folder.iterdir() if each.suffix in (".json", ".nvm"))
    text = file.read_text()
    for name in NAMES:
        text = text.replace(name, f"Küche{chr(34) if file.suffix == '.nvm' else ' '}{name}")
    file.write_text(text, encoding="utf-8")
    pictures = given_pictures(folder) or []
    assert [unicodedata.normalize("NFC", picture.name) for picture in pictures] == [
        f"Küche {Path(name).stem}" for name in NAMES
    ]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_as_windows_writes_them(encoding: str, folder: Path, recording: Path, frames) -> None:
    put_poses(folder, recording)
    for name in ("poses.txt", "K.txt"):
        (folder / name).write_bytes((folder / name).read_text().replace("\n", "\r\n").encode(encoding))
    check_cameras(given_pictures(folder), frames, "poses")


@pytest.mark.parametrize("put", [put_transforms, put_cameras])
def test_paths_from_windows(put, folder: Path, frames) -> None:
    """Backslashes; those of masks and depth were not found, only those of images."""
    put(folder, frames)
    file = folder / ("transforms.json" if put is put_transforms else "cameras.json")
    content = json.loads(file.read_text())
    if put is put_transforms:
        (folder / "masks" / "left").mkdir(parents=True)
        half = np.where(np.arange(112) < 56, 0, 255).astype(np.uint8) * np.ones((84, 1), np.uint8)
        for entry in content["frames"]:
            name = Path(entry["file_path"]).name
            Image.fromarray(half).save(folder / "masks" / "left" / name)
            entry.update(file_path=f".\\images\\{name}", mask_path=f"masks\\left\\{name}")
    else:
        for entry in content:
            entry["name"] = f"images\\{entry['name']}"
    file.write_text(json.dumps(content))
    pictures = given_pictures(folder) or []
    assert [picture.name for picture in pictures] == [Path(name).stem for name in NAMES]
    if put is put_transforms:
        mask = pictures[0].read(SIZE).mask
        assert mask is not None
        assert torch.equal(mask[0, 0], (torch.arange(112) >= 56).float())
