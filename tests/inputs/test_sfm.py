"""Cameras by structure from motion: on real photographs, and what happens around it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.reconstruction.conftest import STAND_IN
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.geometry.alignment import align_points
from vg2gt.geometry.cameras import camera_centers, project
from vg2gt.inputs import sfm
from vg2gt.inputs.inputs import load_views
from vg2gt.inputs.lenses import own_lenses
from vg2gt.inputs.pictures import Picture, find_pictures
from vg2gt.io import colmap_images, read_colmap
from vg2gt.io.image_files import focal_length
from vg2gt.metrics.cameras import relative_pose_errors
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras

COUNT, SIZE = 8, (320, 480)


@pytest.fixture(scope="module")
def office(shared: Path) -> Path:
    return shared / "data" / "hololens_office_a"


@pytest.fixture(scope="module")
def given(office: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight photographs that overlap, and one of nothing that they show."""
    folder = tmp_path_factory.mktemp("holiday") / "photos"
    folder.mkdir()
    for path in sorted((office / "images").iterdir())[:COUNT]:
        shutil.copy(path, folder / path.name)
    noise = np.random.default_rng(0).integers(0, 255, (360, 540, 3), np.uint8)
    Image.fromarray(noise).save(folder / "99999 of something else.png")
    return folder


@pytest.fixture(scope="module")
def solved(given: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the result is kept."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("outputs") / "room" / "sfm"
    monitor = Monitor()
    sfm.find_cameras(find_pictures(given), folder, monitor)
    assert list(monitor.seconds) == ["read photographs", "find features", "match features", "place cameras"]
    return folder


def again(given: Path, folder: Path) -> list[Picture]:
    return sfm.find_cameras(find_pictures(given), folder, Monitor())


@pytest.fixture
def unsolvable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "_solve", lambda *_: pytest.fail("computed again"))


@pytest.mark.usefixtures("unsolvable")
def test_same_images_are_not_computed_again_and_the_unplaced_is_named(given: Path, solved: Path, caplog) -> None:
    pictures = again(given, solved)
    assert [picture.name for picture in pictures] == [picture.name for picture in find_pictures(given)[:COUNT]]
    assert "1 of 9 images overlap too little" in caplog.text
    assert "left out: 99999 of something else" in caplog.text
    assert {picture.source for picture in pictures} == {"structure from motion, 8 of 9 images"}
    lenses = json.loads((solved / "sfm.json").read_text())["lenses"]  # of the photographs as taken, for control points
    sizes = {picture.name: picture.size for picture in find_pictures(given)[:COUNT]}
    assert {name: tuple(map(int, lens.split()[2:0:-1])) for name, lens in lenses.items()} == sizes


def test_other_images_and_damaged_results_are_computed_anew(given: Path, solved: Path, tmp_path, monkeypatch) -> None:
    folder, photos = shutil.copytree(solved, tmp_path / "sfm"), shutil.copytree(given, tmp_path / "photos")
    counts: list[int] = []
    state = json.loads((folder / "sfm.json").read_text())
    monkeypatch.setattr(sfm, "_solve", lambda pictures, *_: counts.append(len(pictures)) or state)
    first = min(photos.iterdir())
    again(photos, folder)
    assert counts == []
    first.write_bytes(first.read_bytes() + b"\0")  # one byte of one file
    again(photos, folder)
    (photos / "99999 of something else.png").unlink()
    again(photos, folder)
    assert counts == [9, 8]
    (folder / "sfm.json").write_text('{"key": ')
    again(given, folder)
    shutil.copy(solved / "sfm.json", folder)
    (folder / "images" / "000003.jpg").unlink()
    again(given, folder)
    assert counts == [9, 8, 9, 9]


def test_cameras_are_those_of_the_recording(given: Path, solved: Path, office: Path) -> None:
    views = load_views(again(given, solved), SIZE, Monitor())
    found = views.hints.cameras
    poses = np.linalg.inv(np.loadtxt(office / "poses.txt").reshape(-1, 4, 4)[:COUNT])
    true = Cameras(torch.from_numpy(poses)[None].float(), found.intrinsics, found.size)
    rotation, _ = relative_pose_errors(found, true)
    assert rotation.median() < 1
    centers = [camera_centers(cameras) for cameras in (found, true)]
    similarity = align_points(*centers)
    extent = torch.cdist(centers[1], centers[1]).max()
    assert (similarity.apply(centers[0]) - centers[1]).norm(dim=-1).median() < 0.03 * extent
    # Of images resized from 540 to 480 pixels, apart from what undistortion cut off at their borders.
    focal = np.loadtxt(office / "K.txt")[0, 0] * 480 / 540
    assert found.intrinsics[0, :, 0, 0].numpy() == pytest.approx(focal, rel=0.08)
    names = sorted((office / "depth").iterdir())[:COUNT]
    depth = torch.from_numpy(np.stack([np.array(Image.open(name), np.float32) for name in names])) / 1000
    near, far = views.hints.depth_range[0] * similarity.scale
    assert ((depth > near) & (depth < far))[depth > 0].float().mean() > 0.95
    assert far / near < 6


def test_points_project_to_where_they_were_seen(given: Path, solved: Path) -> None:
    """In our pixels, whose centres are whole numbers: half a pixel's mistake would show."""
    pictures = again(given, solved)
    model = read_colmap(solved / "sparse")
    errors, depths = [], []
    for picture, image in zip(pictures, colmap_images(model), strict=True):
        frames = picture.read(picture.size)
        features = image.get_observation_points2D()
        world = torch.tensor(np.stack([model.points3D[feature.point3D_id].xyz for feature in features])).float()
        pixels, depth = project(world[None, None], Cameras(frames.world_to_camera[None], frames.intrinsics[None], SIZE))
        errors.append(pixels[0, 0] - torch.tensor(np.stack([feature.xy for feature in features])) + 0.5)
        depths.append(depth[0, 0])
    error = torch.cat(errors)
    assert len(error) > 300
    assert error.norm(dim=-1).median() < 0.8
    assert error.mean(0).abs().max() < 0.1
    assert torch.cat(depths).median() == pytest.approx(1, abs=1e-3)


@pytest.mark.usefixtures("unsolvable")
def test_command_keeps_the_cameras_beside_its_output(given: Path, solved: Path, tmp_path: Path, capsys) -> None:
    shutil.copytree(solved, tmp_path / "out" / "sfm")
    arguments = [*STAND_IN, "--size", "70", "--quiet", "--device", "cpu", "--refine", "0"]
    arguments += ["--save", "scene.ply,report.json"]
    reconstruct_command.main([str(given), "--out", str(tmp_path / "out"), *arguments])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["views"], report["cameras"]) == (COUNT, "structure from motion, 8 of 9 images")
    assert report["cameras"] in capsys.readouterr().out


def test_images_without_a_model_and_folders_of_others_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    images = [np.full((60, 80, 3), 40 * i, np.uint8) for i in range(3)]
    with pytest.raises(ValueError, match=r"cannot find the cameras of these 3 images.*20 or more.*da3_small"):
        sfm.find_cameras(find_pictures(images), tmp_path / "sfm", Monitor())
    with pytest.raises(ValueError, match=r"a single image"):
        sfm.find_cameras(find_pictures(images[:1]), tmp_path / "sfm", Monitor())
    assert not (tmp_path / "sfm").exists()
    (tmp_path / "thesis.txt").write_text("three years")
    with pytest.raises(FileExistsError, match="contains other files"):
        sfm.find_cameras(find_pictures(images), tmp_path, Monitor())


def test_images_of_one_size_and_focal_length_share_a_lens(photos: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26  # millimetres of 35 mm film
    for name in ("IMG_20.jpg", "IMG_21.jpg"):
        Image.new("RGB", (2000, 1500)).save(tmp_path / name, exif=exif)
    pictures = find_pictures([photos, tmp_path])
    expected = 26 * 2500 / np.hypot(36, 24)
    assert [picture.focal for picture in pictures] == [None] * 4 + [pytest.approx(expected)] * 2
    assert focal_length(tmp_path / "nowhere.jpg", (2, 2)) is None
    for width, is_known in ((4000, True), (4500, False)):  # of the whole photograph: one is resized, the other cropped
        exif.get_ifd(0x8769).update({0xA002: width, 0xA003: 3000})
        Image.new("RGB", (2000, 1500)).save(tmp_path / "IMG_21.jpg", exif=exif)
        assert (focal_length(tmp_path / "IMG_21.jpg", (2000, 1500)) is not None) == is_known
    exif.get_ifd(0x8769).update({0xA002: 2000, 0xA003: 1500})
    Image.new("RGB", (2000, 1500)).save(tmp_path / "IMG_21.jpg", exif=exif)
    (tmp_path / "work").mkdir()
    lenses = sfm._stage(pictures, tmp_path / "work", lambda: None)
    assert {key: len(names) for key, names in lenses.items()} == {
        (84, 112, 0): 2,
        (336, 448, 0): 1,
        (84, 56, 0): 1,
        (1200, 1600, round(expected * 0.8, 1)): 2,
    }


def test_masks_go_through(office: Path, tmp_path: Path) -> None:
    """No feature is taken where a mask says so, and the mask is that of the undistorted image."""
    pycolmap = pytest.importorskip("pycolmap")
    photos = tmp_path / "photos"
    (photos / "masks").mkdir(parents=True)
    for number, path in enumerate(sorted((office / "images").iterdir())[:6]):
        shutil.copy(path, photos / path.name)
        mask = np.full(Image.open(path).size[::-1], 255, np.uint8)
        mask[:, : mask.shape[1] // 5] = 0
        if number:  # the first one has none
            Image.fromarray(mask).save(photos / "masks" / f"{path.stem}.png")
    before = sfm._key(find_pictures(photos))
    pictures = sfm.find_cameras(find_pictures(photos), tmp_path / "sfm", Monitor())
    model = pycolmap.Reconstruction(tmp_path / "sfm" / "sparse")
    features = {image.name: min(point.xy[0] for point in image.points2D) for image in model.images.values()}
    assert len(pictures) == len(features) > 3
    for picture, name in zip(pictures, sorted(features), strict=True):
        mask, edge = picture.read(picture.size).mask, picture.size[1] // 5
        assert (features[name] > edge - 8) == (name != "000000.jpg")
        if name != "000000.jpg":
            assert mask is not None
            assert mask[..., : edge - 8].max() < 0.05
            assert mask[..., 8:-8, edge + 8 : -8].min() > 0.95
    path = next((photos / "masks").iterdir())
    Image.fromarray(255 - np.array(Image.open(path))).save(path)
    assert sfm._key(find_pictures(photos)) != before


@pytest.mark.parametrize("zoom", [1.0, 1.2, 1.5])
def test_images_of_several_focal_lengths_get_their_own_lenses(zoom: float) -> None:
    """Two of ten images are enlarged, though the model has one lens for all."""
    pycolmap = pytest.importorskip("pycolmap")
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0])
    )
    tracks = [pycolmap.Track() for _ in points]
    for number in range(10):
        turn = Rotation.from_euler("y", 12 * number, degrees=True).as_matrix()
        seen = points @ turn.T + (0, 0, 4)
        pixels = 500 * (zoom if number in (3, 7) else 1) * seen[:, :2] / seen[:, 2:] + (320, 240)
        pose = pycolmap.Rigid3d(np.column_stack([turn, (0, 0, 4)]))
        model.add_image_with_trivial_frame(pycolmap.Image(f"{number}.jpg", pixels, 1, number + 1), pose)
        for row, track in enumerate(tracks):
            track.add_element(number + 1, row)
    for place, track in zip(points, tracks, strict=True):
        model.add_point3D(place, track, np.zeros(3, np.uint8))
    names = [f"{number}.jpg" for number in range(12)]  # two have not been placed
    found = own_lenses(model, {(480, 640, 0.0): names})
    assert bool(found) == (zoom > 1)
    if found:
        focals = {name: focal for (_, _, focal), members in found.items() for name in members}
        assert focals["3.jpg"] / focals["2.jpg"] == pytest.approx(zoom, rel=0.05)
        assert found[480, 640, 0.0] == ["10.jpg", "11.jpg"]
