"""What people bring to ``vg2gt reconstruct`` and take away: cameras, names, masks, damaged files, orders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.inputs.test_given_cameras import NAMES, put_cameras, put_colmap, put_transforms
from tests.reconstruction.conftest import SIZE, run
from vg2gt import io
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.cli import render as render_command
from vg2gt.inputs.camera_files import read_cameras
from vg2gt.inputs.cameras import pictures_for
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.inputs.inputs import load_views
from vg2gt.inputs.padding import of_one_shape
from vg2gt.inputs.pictures import find_pictures
from vg2gt.monitor import Monitor
from vg2gt.outputs.saved import read_scene
from vg2gt.reconstruction.order import working_order
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.rendering import Renderer
from vg2gt.runs.load import load_model
from vg2gt.types import Gaussians


@pytest.mark.parametrize("put", [put_colmap, put_cameras])
def test_landscape_and_portrait_mixed_are_read_whole(folder: Path, frames, put) -> None:
    """Sizes were read after the images were cropped to the median shape, without a warning."""
    put(folder, frames)
    turned = folder / "images" / NAMES[3]
    with Image.open(turned) as image:
        image.resize((84, 112)).save(turned)
    if put is put_colmap:
        model = io.read_colmap(folder / "sparse" / "0")
        camera = model.camera(4)
        camera.width, camera.height, camera.params = 84, 112, [77.0, 77.0, 42.0, 56.0]
        io.write_colmap(folder / "sparse" / "0", model)
    else:
        cameras = io.read_cameras_json(folder / "cameras.json")
        cameras[3] = replace(cameras[3], width=84, height=112)
        io.write_cameras_json(folder / "cameras.json", cameras)
    pictures = given_pictures(folder)
    assert [picture.size for picture in pictures] == [SIZE] * 3 + [(112, 84)]
    assert pictures[3].read((112, 84)).images.shape[-2:] == (112, 84)
    shown, size = of_one_shape(pictures, 14, "cpu")
    assert size[0] / size[1] > 0.8  # as without cameras
    assert load_views(shown, size, Monitor()).images.shape[-2:] == size


@pytest.mark.parametrize("layout", ["reduced", "among", "other case", "any folder"])
def test_cameras_are_found_where_people_have_them(folder: Path, frames, layout: str) -> None:
    put_colmap(folder, frames)
    images, given = folder / "images", folder
    if layout == "reduced":
        images.rename(folder / "images_4")
        for path in (folder / "images_4").iterdir():
            with Image.open(path) as image:
                image.reduce(2).save(path)
    elif layout == "among":
        for path in (folder / "sparse" / "0").iterdir():
            shutil.move(path, images / path.name)
        given = images
    elif layout == "other case":
        images.rename(folder / "Images")
    else:
        given = images.rename(folder / "my photographs")
    pictures = given_pictures(given)
    assert [picture.name for picture in pictures] == [Path(name).stem for name in NAMES]
    assert all(picture.source.startswith("COLMAP") for picture in pictures)
    assert torch.allclose(pictures[0].read(SIZE).world_to_camera[0], frames.world_to_camera[0], atol=1e-5)


def test_cameras_that_cannot_be_read_are_no_reason_to_look_for_others(model, folder: Path, frames, monkeypatch):
    """Structure from motion takes minutes: only if it is asked for."""
    put_colmap(folder, frames)
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:100])
    monkeypatch.setattr("vg2gt.inputs.cameras.find_cameras", lambda pictures, *_: pictures)
    with pytest.raises(ValueError, match=r"images\.bin.*--poses sfm ignores them"), pictures_for(model, folder):
        pass
    with pictures_for(model, folder, "sfm") as pictures:
        assert len(pictures) == len(NAMES)
    with pytest.raises(ValueError, match=r"images\.bin"), pictures_for(model, folder, "given"):
        pass


@pytest.mark.parametrize("kind", ["alpha", "masks"])
def test_what_is_hidden_is_no_part_of_the_scene(folder: Path, frames, model, kind: str, tmp_path: Path) -> None:
    """Colours under alpha 0 became scene; masks likewise."""
    put_colmap(folder, frames)
    half = np.where(np.arange(112) < 56, 0, 255).astype(np.uint8) * np.ones((84, 1), np.uint8)
    (folder / "masks").mkdir()
    for name in NAMES:
        path = folder / "images" / name
        if kind == "alpha":
            colours = np.array(Image.open(path)) * (half[..., None] > 0) + [255, 0, 255] * (half[..., None] == 0)
            Image.fromarray(np.dstack((colours, half)).astype(np.uint8)).save(path)
        else:
            Image.fromarray(half).save(folder / "masks" / name)
    scene = reconstruct_with(model, folder)
    assert torch.equal(scene.mask[0, 0], (torch.arange(112) >= 56).float())
    assert (scene.depth[..., :56] == 0).all()
    assert (scene.depth[..., 60:] > 0).any()
    if kind == "alpha":
        assert (scene.images[..., :56] == 1).all()
        magenta = (scene.gaussians.sh[:, 0] * 0.2821 + 0.5 - torch.tensor([1.0, 0, 1])).norm(dim=-1)
        assert magenta.min() > 0.2
    scene.save(tmp_path / "out", ["scene.ply", "cameras.json", "views.npz"])
    again = read_scene(tmp_path / "out", Renderer())
    assert torch.equal(again.mask, scene.mask)


def test_names_of_several_photographs_give_no_camera(folder: Path, frames) -> None:
    put_cameras(folder, frames, names=[f"a/{NAMES[0]}", f"b/{NAMES[0]}", *NAMES[2:]])
    assert [picture.name for picture in given_pictures(folder)] == [Path(name).stem for name in NAMES[2:]]


def test_masks_of_photographs_without_cameras(folder: Path, caplog) -> None:
    """Also one folder up, in colour, and alpha of Pillow images."""
    (folder / "masks").mkdir()
    Image.new("RGB", (112, 84), 0).save(folder / "masks" / f"{NAMES[1]}.png")
    Image.new("L", (112, 84), 0).save(folder / "masks" / f"{Path(NAMES[2]).stem}.PNG")
    views = load_views(find_pictures(folder / "images"), SIZE, Monitor())
    assert views.mask.mean((1, 2)).tolist() == [1, 0, 0, 1]
    assert (
        f"2 of 4 images have no mask in {folder / 'masks'}; all their pixels are used: {folder / 'images' / NAMES[0]}"
        in caplog.text
    )
    image = Image.new("RGBA", (112, 84), (255, 0, 255, 0))
    views = load_views(find_pictures([image]), SIZE, Monitor())
    assert not views.mask.any()
    assert (views.images == 1).all()


def test_photographs_come_back_with_their_names_and_sizes(folder: Path, frames, tmp_path: Path) -> None:
    put_colmap(folder, frames)
    run(folder, "--out", tmp_path / "out", "--save", "colmap,nerfstudio", "--size", "56x56")
    whole = tmp_path / "out" / "colmap"
    model = io.read_colmap(whole / "sparse" / "0")
    for number, image in enumerate(io.colmap_images(model)):
        assert image.name == NAMES[number]
        assert (whole / "images" / image.name).read_bytes() == (folder / "images" / image.name).read_bytes()
        np.testing.assert_allclose(io.colmap_intrinsics(image.camera), frames.intrinsics[number], atol=1e-3)
        np.testing.assert_allclose(io.colmap_pose(image), frames.world_to_camera[number], atol=1e-6)
    content = json.loads((tmp_path / "out" / "nerfstudio" / "transforms.json").read_text())
    assert [frame["file_path"] for frame in content["frames"]] == [f"images/{name}" for name in NAMES]


def test_a_damaged_photograph_is_left_out_by_name(photos: Path, tmp_path: Path, caplog) -> None:
    folder = Path(shutil.copytree(photos, tmp_path / "photos"))
    path = folder / "IMG_9.jpg"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (folder / "IMG_12.jpg").write_text("no picture")
    assert "IMG_12" not in [picture.name for picture in find_pictures(folder)]
    assert "IMG_12.jpg cannot be read" in caplog.text
    (folder / "IMG_12.jpg").unlink()
    with pytest.raises(ValueError, match=r"IMG_9\.jpg"):
        load_views(find_pictures(folder), SIZE, Monitor())


def test_images_and_a_photograph_beside_their_folder(folder: Path, caplog) -> None:
    shutil.copy(folder / "images" / NAMES[0], folder / "preview.png")
    assert len(find_pictures(folder)) == 4
    assert "1 next to it are ignored" in caplog.text


def test_the_order_of_photographs_decides_nothing_and_copies_count_once(folder: Path, frames, model, caplog) -> None:
    put_colmap(folder, frames)
    files = [folder / "images" / name for name in NAMES]
    one = reconstruct_with(model, files)
    other = reconstruct_with(model, [files[2], files[0], files[3], files[1]])
    assert other.names == ("010", "008", "011", "009")
    for view, same in zip(one.render(other.named_cameras()), other.render(), strict=True):
        assert (view.color - same.color).square().mean() < 1e-5
    shutil.copy(files[1], folder / "images" / "copy.png")
    (folder / "sparse").rename(folder / "elsewhere")
    images_alone = load_model(backend="da3_tiny", device="cpu").model
    scene = reconstruct_with(images_alone, [*files, folder / "images" / "copy.png"])
    assert scene.names == ("008", "009", "010", "011")
    assert "1 images are copies of others and are left out: copy (as 009)" in caplog.text


def test_the_reference_is_the_view_that_shows_what_the_others_show() -> None:
    images = torch.rand(5, 3, 56, 70, generator=torch.Generator().manual_seed(0))
    images[1:] = 0.3 * images[1:] + 0.7 * images[1:2]
    order = working_order(images)
    assert order[0] != 0
    shuffled = [3, 1, 4, 0, 2]
    assert [shuffled[view] for view in working_order(images[shuffled])] == order


def test_render_refuses_a_scene_of_nothing(tmp_path: Path, frames) -> None:
    put_cameras(tmp_path, frames)
    none = torch.ones(0, 3)
    scene = Gaussians(none, torch.ones(0, 4), none, none[:, 0], none[:, None], torch.zeros(0, dtype=torch.int64))
    path = io.write_gaussian_ply(tmp_path / "scene.ply", scene)
    with pytest.raises(SystemExit, match="holds no Gaussians; there is nothing to render"):
        render_command.main([str(path), "--cameras", str(tmp_path / "cameras.json"), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_cameras_to_render_come_from_any_file(folder: Path, frames) -> None:
    put_colmap(folder, frames)
    put_transforms(folder, frames)
    put_cameras(folder, frames)
    for place in ("", "sparse/0", "transforms.json", "cameras.json"):
        cameras = read_cameras(folder / place)
        assert [(camera.width, camera.height) for camera in cameras] == [(112, 84)] * 4
        for camera, pose, matrix in zip(cameras, frames.world_to_camera, frames.intrinsics, strict=True):
            np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-5)
            np.testing.assert_allclose(camera.intrinsics, matrix, atol=1e-4)


def test_without_pycolmap_one_line_comes_before_any_work(folder: Path, frames, tmp_path: Path, monkeypatch) -> None:
    """Photographs whose cameras cannot be found, and a COLMAP model that cannot be read."""
    put_colmap(shutil.copytree(folder, tmp_path / "model"), frames)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("vg2gt.runs.load.build_model", lambda *_: pytest.fail("built a model"))
    for place, said in ((folder, "finding the cameras"), (tmp_path / "model", "reading the COLMAP model")):
        with pytest.raises(SystemExit, match=rf"{said} .* needs pycolmap: pip install 'vg2gt\[colmap\]'"):
            reconstruct_command.main([str(place), "--out", str(tmp_path / "out"), "--quiet", "--device", "cpu"])
    assert not (tmp_path / "out").exists()
