"""RGB-D folders: round trip, layouts, splits, damage, and real recordings by geometry."""

import shutil
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import DataError, RGBDFolder, SceneDataModule

from .conftest import SIZE
from .sources.layout_rgbd import write_seven_scenes
from .sources.layouts import room
from .warping import depth_differences


def test_intrinsics_beside_the_sequences_of_seven_scenes(tmp_path, caplog):
    write_seven_scenes(tmp_path / "data", room(2))
    root, path = tmp_path / "data" / "chess", tmp_path / "data" / "chess" / "camera-intrinsics.txt"
    for focal in (30, 60):  # read again when they are edited
        np.savetxt(path, [[focal, 0, 15], [0, 31, 11], [0, 0, 1]])
        source = RGBDFolder(str(root), index_cache=str(tmp_path / "cache"))
        assert float(source.load("seq-01", [0]).intrinsics[0, 0, 0]) == focal
    assert "not registered" in caplog.text
    path.unlink()
    with pytest.raises(DataError, match=r"no intrinsics.*data.intrinsics=\[fx,fy,cx,cy\]"):
        RGBDFolder(str(root)).frames("seq-01")
    given = RGBDFolder(str(root), intrinsics=(30, 31, 15.5, 11.5))
    assert given.scenes == ("seq-01",)
    assert given.load("seq-01", [0]).intrinsics[0].tolist() == [[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]]


def test_recordings_of_one_room_show_one_place(write_recording):
    folder = write_recording()
    root = folder.parent / "all"
    names = ("kitchen/seq-01", "kitchen/seq-02", "office/seq-01", "scans/scene0000_00", "scans/scene0000_01", "me/hall")
    for name in names:
        shutil.copytree(folder, root / name)
    source = RGBDFolder(str(root))
    places = {"kitchen": 2, "office": 1, "scene0000": 2, "me/hall": 1}
    assert Counter(source.place(name) for name in names) == places
    alone = RGBDFolder(str(root / "kitchen" / "seq-02"))
    assert alone.place("seq-02") == "kitchen"


def test_shared_intrinsics_follow_the_colour_images_to_the_size_of_the_depth(write_recording, caplog):
    folder = write_recording()
    expected = RGBDFolder(str(folder)).load("office", [10]).intrinsics
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            larger = image.resize((2 * SIZE[1], 2 * SIZE[0]))
        larger.save(path)
    matrix = np.loadtxt(folder / "K.txt")
    matrix[:2, :2] *= 2
    matrix[:2, 2] = 2 * (matrix[:2, 2] + 0.5) - 0.5
    np.savetxt(folder / "K.txt", matrix)
    frames = RGBDFolder(str(folder)).load("office", [10])
    assert frames.images.shape[-2:] == SIZE
    assert "colour of 64x48 is reduced to the depth's 32x24" in caplog.text
    torch.testing.assert_close(frames.intrinsics, expected)


def test_invalid_values_become_zero(write_recording):
    folder = write_recording()
    path = folder / "depth" / "00010.png"
    stored = np.array(Image.open(path))
    stored[0, :4] = (0, 65535, 7, 2000)
    Image.fromarray(stored).save(path)
    depth = RGBDFolder(str(folder), invalid=(0, 7, 65535), depth_scale=2000).load("office", [10]).depth
    assert depth[0, 0, :4].tolist() == [0, 0, 0, 1]


def test_held_out_frames_are_targets_and_never_trained_on(write_recording):
    source = RGBDFolder(str(write_recording()), holdout=3)
    assert list(source.held_out("office")) == [11, 14]
    module = SceneDataModule(
        train=source,
        val=source,
        image_size=SIZE,
        min_views=2,
        max_views=4,
        eval_context=3,
        eval_target=5,
        steps_per_epoch=40,
    )
    trained = {frame for batch in module.train_dataloader() for frame in batch.frame_ids.flatten().tolist()}
    assert trained == {10, 12, 13, 15}
    (batch,) = module.val_dataloader()
    assert batch.target.frame_ids.tolist() == [[11, 14]]
    assert set(batch.context.frame_ids[0].tolist()) <= trained
    without = RGBDFolder(str(source.scene_index("office").folder), holdout=None)
    with pytest.raises(DataError, match="office is used for training and for evaluation"):
        SceneDataModule(train=without, val=without, min_views=2, max_views=2, eval_context=2, eval_target=1).setup()


def test_a_folder_of_recordings_splits_by_scene(write_recording):
    root = write_recording("a").parent
    write_recording("b", scene=1)
    assert RGBDFolder(str(root)).scenes == ("a", "b")
    assert RGBDFolder([str(root / "b"), str(root / "a")]).scenes == ("b", "a")
    module = SceneDataModule(
        train=RGBDFolder(str(root), scenes=["a"], holdout=None),
        val=RGBDFolder(str(root), scenes=["b"]),
        image_size=SIZE, min_views=2, max_views=2, eval_context=2, eval_target=1,
    )  # fmt: skip
    module.setup()
    assert next(iter(module.val_dataloader())).scene == ("b",)
    with pytest.raises(DataError, match="no scene c; found are: a, b"):
        RGBDFolder(str(root), scenes=["c"])
    with pytest.raises(DataError, match="two scenes are called a"):
        RGBDFolder([str(root / "a"), str(root / "a")])


def test_a_missing_root_names_the_path_and_the_remedy(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.*data\.root=FOLDER"):
        RGBDFolder(str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"data\.root is not set.*data\.root=FOLDER"):
        RGBDFolder(None)
    with pytest.raises(DataError, match=r"no scene in .*expected images.*; found: "):
        RGBDFolder(str(tmp_path))


def _truncate(path):
    path.write_bytes(path.read_bytes()[:120])


def _save(path, array):
    Image.fromarray(array).save(path)


def _drop_a_pose(folder):
    path = folder / "poses.txt"
    path.write_text("\n".join(path.read_text().splitlines()[1:]))


def _empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()


def _widen(folder):
    for path in folder.iterdir():
        _save(path, np.ones((24, 40, 3), np.uint8))


def _matrix(folder: Path, place: tuple[int, int], value: float) -> None:
    matrix = np.loadtxt(folder / "K.txt")
    matrix[place] = value
    np.savetxt(folder / "K.txt", matrix)


def _short_log(folder: Path) -> None:
    (folder / "poses.txt").unlink()
    (folder / "trajectory.log").write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


def _odd_json(folder: Path) -> None:
    (folder / "K.txt").unlink()
    (folder / "camera_intrinsic.json").write_text('{"intrinsic_matrix": [1, 2]}')


def _transposed(folder: Path) -> None:
    np.savetxt(folder / "K.txt", np.loadtxt(folder / "K.txt").T)


def _resized(folder: Path, factor: float) -> None:
    np.savetxt(folder / "K.txt", np.diag([factor, factor, 1]) @ np.loadtxt(folder / "K.txt"))


DAMAGE = {
    "no images": (lambda f: _empty(f / "images"), "scene office has no colour images"),
    "image removed": (
        lambda f: (f / "images/00012.png").unlink(),
        "one line of 16 numbers .* for each of the 5 images; it has 6",
    ),
    "poses missing": (
        lambda f: (f / "poses.txt").unlink(),
        r"scene office in .* has 6 colour and 6 depth images but no poses: add poses\.txt",
    ),
    "an odd log": (_short_log, r"trajectory\.log of scene office has 1 poses for 6 images"),
    "another json": (_odd_json, r"camera_intrinsic\.json: expected Open3D's intrinsic_matrix"),
    "a pose missing": (_drop_a_pose, "each of the 6 images; it has 5 lines of 16"),
    "words": (lambda f: (f / "poses.txt").write_text("a b\n"), r"cannot read .*poses\.txt of scene office"),
    "not rigid": (
        lambda f: np.savetxt(f / "poses.txt", 2 * np.loadtxt(f / "poses.txt")),
        "frame 10 in .*scene office.* not a rigid",
    ),
    "not finite": (
        lambda f: np.savetxt(f / "poses.txt", np.full((6, 16), np.nan)),
        "no usable frame .*; 6 frames whose pose is not finite",
    ),
    "no intrinsics": (lambda f: (f / "K.txt").unlink(), r"no intrinsics: add K\.txt"),
    "no 3x3": (lambda f: np.savetxt(f / "K.txt", np.ones((2, 3))), r"K\.txt .* 3x3 or 4x4 or 1x4 matrix, not 2x3"),
    "a transposed matrix": (_transposed, r"are not fx 0 cx, 0 fy cy, 0 0 1 \(transposed"),
    "skew": (lambda f: _matrix(f, (0, 1), 3.0), "have skew, which is not modelled"),
    "a distant principal point": (lambda f: _matrix(f, (0, 2), 1e5), "is far outside"),
    "the matrix of larger images": (
        lambda f: _resized(f, 2),
        r"K\.txt of scene .* another resolution \(about 62x46\)\? Scale it",
    ),
    "the matrix of smaller images": (lambda f: _resized(f, 0.25), r"another resolution \(about 8x6\)"),
    "no focal length": (lambda f: np.savetxt(f / "K.txt", np.zeros((3, 3))), "no positive focal lengths"),
    "truncated image": (lambda f: _truncate(f / "images/00012.png"), r"cannot read .*s/00012\.png of scene office"),
    "truncated depth": (lambda f: _truncate(f / "depth/00012.png"), r"cannot read .*h/00012\.png of scene office"),
    "wrong size": (
        lambda f: _save(f / "depth/00012.png", np.ones((24, 30), np.uint16)),
        r"00012\.png of scene office is 30x24 .* 32x24",
    ),
    "other aspect ratio": (lambda f: _widen(f / "images"), "different aspect ratios"),
    "colour for depth": (
        lambda f: _save(f / "depth/00012.png", np.ones((*SIZE, 3), np.uint8)),
        r"00012\.png of scene office is not a depth image",
    ),
    "no valid depth": (
        lambda f: _save(f / "depth/00012.png", np.full(SIZE, 65535, np.uint16)),
        r"00012\.png of scene office has no valid depth",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_by_file_and_scene(write_recording, name):
    folder = write_recording()
    damage, message = DAMAGE[name]
    damage(folder)
    with pytest.raises(DataError, match=message):
        RGBDFolder(str(folder)).load("office", range(10, 16))


def test_any_damage_to_an_image_is_a_data_error_or_a_picture(write_recording):
    folder = write_recording()
    source = RGBDFolder(str(folder))
    rng = np.random.default_rng(0)
    failures = 0
    for kind in ("images", "depth"):
        path = folder / kind / "00012.png"
        whole = path.read_bytes()
        for _ in range(100):
            damaged = bytearray(whole[: rng.integers(1, len(whole))] if rng.random() < 0.3 else whole)
            for place in rng.integers(0, len(damaged), 3):
                damaged[place] = rng.integers(256)
            path.write_bytes(bytes(damaged))
            try:
                assert source.load("office", [12]).images.shape == (1, 3, *SIZE)
            except DataError as error:
                failures += "00012.png" in str(error)
        path.write_bytes(whole)
    assert failures > 50


def test_a_recording_of_one_frame(write_recording):
    folder = write_recording(frames=1)
    source = RGBDFolder(str(folder))
    assert list(source.frames("office")) == [10]
    assert list(source.held_out("office")) == []
    assert source.load("office", [10]).depth.shape == (1, *SIZE)


def test_hololens_frames_agree_as_its_description_says(shared):
    source = RGBDFolder(str(shared / "data/hololens_office_a"))
    ids = source.frames("hololens_office_a")
    assert len(ids) == 24
    frames = source.load("hololens_office_a", ids)
    assert float((frames.depth > 0).float().mean()) == pytest.approx(0.715, abs=0.001)
    neighbours = [depth_differences(frames, a, b, stride=2)[0] for a, b in pairwise(range(24))]
    assert np.median([float(d.median()) for d in neighbours]) == pytest.approx(2.4e-3, rel=0.1)
    pairs = [depth_differences(frames, a, b, stride=3) for a in range(24) for b in range(24) if abs(a - b) >= 8]
    far = [float(differences.median()) for differences, overlap in pairs if overlap >= 0.3]
    assert np.median(far) == pytest.approx(7.2e-3, rel=0.1)


def test_registered_seven_scenes_frames_agree_as_their_description_says(shared):
    source = RGBDFolder(str(shared / "data/seven_scenes_redkitchen_a_registered"))
    (scene,) = source.scenes
    ids = source.frames(scene)
    assert len(ids) == 56
    frames = source.load(scene, ids)
    pairs = [depth_differences(frames, a, b, stride=10) for a in range(56) for b in range(a + 1, 56)]
    medians = [float(differences.median()) for differences, overlap in pairs if overlap >= 0.3]
    assert np.median(medians) == pytest.approx(12.0e-3, rel=0.1)


def test_raw_seven_scenes_depth_agrees_as_its_description_says(shared):
    source = RGBDFolder(str(shared / "data/seven_scenes_redkitchen_a"), holdout=None)
    (scene,) = source.scenes
    frames = source.load(scene, source.frames(scene))
    assert float((frames.depth > 0).float().mean()) == pytest.approx(0.883, abs=0.001)
    count = len(frames.depth)
    pairs = [depth_differences(frames, a, b, stride=10) for a in range(count) for b in range(count) if a != b]
    together = torch.cat([differences for differences, overlap in pairs if overlap >= 0.3])
    assert float(together.median()) == pytest.approx(12.2e-3, rel=0.1)
    assert float((together < 0.03).float().mean()) == pytest.approx(0.78, abs=0.02)
    neighbours = [float(depth_differences(frames, a, a + 1, stride=4)[0].median()) for a in range(count - 1)]
    assert np.median(neighbours) == pytest.approx(6.0e-3, rel=0.1)


def test_a_real_recording_with_quaternions(shared):
    """Its description says: poses are rough, depth of two frames differs by 76 mm in the median."""
    source = RGBDFolder(str(shared / "data" / "slambook_rgbd"), intrinsics=(518, 519, 325.5, 253.5), holdout=None)
    (scene,) = source.scenes
    frames = source.load(scene, source.frames(scene))
    assert len(frames.images) == 5
    found = [depth_differences(frames, a, b, stride=4)[0] for a in range(5) for b in range(5) if a != b]
    assert 0.05 < float(torch.cat(found).median()) < 0.12
