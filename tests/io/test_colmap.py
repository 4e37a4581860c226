"""COLMAP models: exact round trips, real models by geometry, damaged files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.geometry.cameras import project
from vg2gt.io import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    FormatError,
    colmap_camera,
    colmap_from_views,
    colmap_image,
    colmap_intrinsics,
    colmap_pose,
    read_colmap,
    write_colmap,
)
from vg2gt.io.colmap_records import CAMERA_MODELS
from vg2gt.types import Cameras

FILES = ("cameras", "images", "points3D")


def small_model(seed: int = 0, points: int = 7) -> ColmapModel:
    """Every camera model once, images with and without features, points with tracks of different lengths."""
    rng = np.random.default_rng(seed)
    cameras = {
        number + 3: ColmapCamera(number + 3, name, 640 + number, 480, tuple(rng.normal(size=len(params)).tolist()))
        for name, (number, params) in CAMERA_MODELS.items()
    }
    images = {}
    for i, camera in enumerate(cameras, 11):
        quat, translation = rng.normal(size=4).tolist(), rng.normal(size=3).tolist()
        features = rng.uniform(0, 480, (i % 3, 2)), rng.integers(-1, 5, i % 3)
        images[i] = ColmapImage(i, tuple(quat), tuple(translation), camera, f"folder/é{i}.png", *features)
    lengths = rng.integers(0, 4, points)
    observers = 11 + 3 * rng.integers(0, 5, lengths.sum()) + 2  # images with at least one feature
    observers = np.array([i for i in observers if len(images[i].points2d)] or [12])
    tracks = np.stack((rng.choice(observers, lengths.sum()), np.zeros(lengths.sum(), np.int64)), -1)
    return ColmapModel(
        cameras,
        images,
        ColmapPoints(
            rng.permutation(points * 2)[:points].astype(np.int64) + 1,
            rng.normal(size=(points, 3)),
            rng.integers(0, 256, (points, 3)).astype(np.uint8),
            rng.uniform(size=points),
            tracks.astype(np.int64),
            lengths.astype(np.int64),
        ),
    )


def assert_same(a: ColmapModel, b: ColmapModel) -> None:
    assert list(a.cameras.values()) == list(b.cameras.values())
    assert list(a.images) == list(b.images)
    for one, other in zip(a.images.values(), b.images.values(), strict=True):
        for name in ("id", "quat", "translation", "camera_id", "name"):
            assert getattr(one, name) == getattr(other, name)
        np.testing.assert_array_equal(one.points2d, other.points2d)
        np.testing.assert_array_equal(one.point3d_ids, other.point3d_ids)
    for name in ColmapPoints.__dataclass_fields__:
        one, other = getattr(a.points, name), getattr(b.points, name)
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("points", [0, 1, 50])
def test_round_trip_is_exact(tmp_path: Path, text: bool, points: int) -> None:
    model = small_model(points=points)
    assert_same(read_colmap(write_colmap(tmp_path / "sparse", model, text=text)), model)
    assert len(list((tmp_path / "sparse").iterdir())) == 3


def test_empty_model(tmp_path: Path) -> None:
    model = ColmapModel({}, {}, ColmapPoints.empty())
    assert_same(read_colmap(write_colmap(tmp_path, model)), model)


def test_half_a_pixel_lies_between_the_conventions() -> None:
    intrinsics = np.array([[500.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]])
    camera = colmap_camera(4, intrinsics, (480, 640))
    assert camera == ColmapCamera(4, "PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0))
    np.testing.assert_array_equal(colmap_intrinsics(camera), intrinsics)
    simple = ColmapCamera(1, "SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.1))
    np.testing.assert_array_equal(colmap_intrinsics(simple), [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    assert not simple.is_pinhole
    with pytest.raises(ValueError, match="EQUIRECTANGULAR"):
        colmap_intrinsics(ColmapCamera(1, "EQUIRECTANGULAR", 640, 480, (640.0, 480.0)))


def test_pose_round_trip_and_poses_that_are_none() -> None:
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
    pose[:3, 3] = 1, -2, 3
    image = colmap_image(1, pose, 1, "a.png")
    np.testing.assert_allclose(colmap_pose(image), pose, atol=1e-15)
    for quat in ((0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)):
        broken = ColmapImage(1, quat, (0.0, 0.0, 0.0), 1, "a", image.points2d, image.point3d_ids)
        assert np.isnan(colmap_pose(broken)).all()


def radial_project(model: ColmapModel, image: ColmapImage, xyz: np.ndarray) -> np.ndarray:
    """Pixels in our convention; SIMPLE_RADIAL scales normalised coordinates by 1 + k r^2."""
    camera = model.cameras[image.camera_id]
    pose, k = colmap_pose(image), colmap_intrinsics(camera)
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    uv = local[:, :2] / local[:, 2:]
    if camera.model == "SIMPLE_RADIAL":
        uv = uv * (1 + camera.param("k") * (uv**2).sum(-1, keepdims=True))
    return uv * k[[0, 1], [0, 1]] + k[:2, 2]


@pytest.mark.parametrize(("folder", "median"), [("dense/0/sparse", 0.25), ("sparse/0", 0.74)])
def test_real_model_reprojects(shared: Path, tmp_path: Path, folder: str, median: float) -> None:
    source = shared / "data" / "colmap_statue" / folder
    model = read_colmap(source)
    assert (len(model.images), len(model.cameras), len(model.points)) == (23, 23, 1443)
    row_of = {int(number): row for row, number in enumerate(model.points.ids)}
    errors = []
    for image in model.images.values():
        seen = image.point3d_ids >= 0
        xyz = model.points.positions[[row_of[int(number)] for number in image.point3d_ids[seen]]]
        pixels = radial_project(model, image, xyz)
        errors.append(np.linalg.norm(pixels - (image.points2d[seen] - 0.5), axis=-1))
    assert np.median(np.concatenate(errors)) == pytest.approx(median, abs=0.01)
    written = write_colmap(tmp_path / "binary", model)
    for name in FILES:
        assert (written / f"{name}.bin").read_bytes() == (source / f"{name}.bin").read_bytes()
    assert_same(read_colmap(write_colmap(tmp_path / "text", model, text=True)), model)


def views_model(points: int = 60) -> tuple[ColmapModel, Cameras]:
    """Points seen by three views of our own, each observed where its source view projects it."""
    rng = np.random.default_rng(1)
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    poses[0, :, 0, 3] = torch.tensor([0.0, -0.3, 0.4])
    intrinsics = torch.tensor([[80.0, 0, 47.5], [0, 82.0, 31.5], [0, 0, 1]]).repeat(1, 3, 1, 1)
    cameras = Cameras(poses, intrinsics, (64, 96))
    xyz = rng.uniform([-0.4, -0.4, 2], [0.4, 0.4, 4], (points, 3))
    views = rng.integers(0, 3, points)
    spread = torch.from_numpy(xyz).float()[None, None].expand(1, 3, -1, -1)
    pixels = project(spread, cameras)[0][0].numpy()[views, np.arange(points)]
    colors = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    return colmap_from_views(cameras, ["a.png", "b.png", "c.png"], xyz, colors, (views, pixels)), cameras


def test_own_views_become_a_model_whose_observations_agree(tmp_path: Path) -> None:
    model, cameras = views_model()
    model = read_colmap(write_colmap(tmp_path, model))
    assert [image.name for image in model.images.values()] == ["a.png", "b.png", "c.png"]
    np.testing.assert_array_equal(colmap_intrinsics(model.cameras[2]), cameras.intrinsics[0, 1].numpy())
    for number, position, (image, row) in zip(
        model.points.ids, model.points.positions, model.points.tracks, strict=True
    ):
        observer = model.images[int(image)]
        assert observer.point3d_ids[row] == number
        pixel = radial_project(model, observer, position[None])[0]
        np.testing.assert_allclose(pixel, observer.points2d[row] - 0.5, atol=1e-4)


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    _, cameras = views_model()
    with pytest.raises(ValueError, match=r"names \(1\)"):
        colmap_from_views(cameras, ["a.png"])
    with pytest.raises(ValueError, match="uint8"):
        colmap_from_views(cameras, ["a", "b", "c"], np.zeros((2, 3)), np.zeros((2, 3)))
    model = small_model()
    blank = colmap_image(11, np.eye(4), 3, "a b.png")
    model.images[11] = blank
    with pytest.raises(ValueError, match="binary"):
        write_colmap(tmp_path / "text", model, text=True)
    assert not (tmp_path / "text").exists()
    assert read_colmap(write_colmap(tmp_path / "binary", model)).images[11].name == "a b.png"
    with pytest.raises(FileExistsError, match=r"cameras\.bin"):
        write_colmap(tmp_path / "binary", small_model(), text=True)


@pytest.mark.parametrize("text", [False, True])
def test_numpy_numbers_are_written_as_numbers(tmp_path: Path, text: bool) -> None:
    camera = ColmapCamera(1, "SIMPLE_PINHOLE", 64, 48, tuple(np.array([1 / 3, 32.0, 24.0])))
    image = ColmapImage(
        1, tuple(np.array([1.0, 0, 0, 0])), tuple(np.full(3, 1e-7)), 1, "a", np.zeros((0, 2)), np.zeros(0, np.int64)
    )
    model = ColmapModel({1: camera}, {1: image}, ColmapPoints.empty())
    read = read_colmap(write_colmap(tmp_path, model, text=text))
    assert read.cameras[1].params == (1 / 3, 32.0, 24.0)
    assert read.images[1].translation == (1e-7, 1e-7, 1e-7)
    with pytest.raises(ValueError, match="stands under number 2"):
        write_colmap(tmp_path, ColmapModel({2: camera}, {}, ColmapPoints.empty()), text=text)


def test_folder_without_a_model(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no COLMAP model here"):
        read_colmap(tmp_path)


def test_counts_are_not_trusted(tmp_path: Path) -> None:
    write_colmap(tmp_path, small_model())
    for name in FILES:
        path = tmp_path / f"{name}.bin"
        content = path.read_bytes()
        path.write_bytes(b"\xff" * 8 + content[8:])
        with pytest.raises(FormatError, match=rf"{name}\.bin, byte 8: a list of 18446744073709551615"):
            read_colmap(tmp_path)
        path.write_bytes(content + b"\0")
        with pytest.raises(FormatError, match="1 bytes follow"):
            read_colmap(tmp_path)
        path.write_bytes(content)


def test_text_errors_name_the_line(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# comment\n1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("# comment\n1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 zero 0 1 b.png\n\n")
    (tmp_path / "points3D.txt").write_text("")
    with pytest.raises(FormatError, match=r"images\.txt, line 4: expected IMAGE_ID.*'zero'"):
        read_colmap(tmp_path)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n10 20 -1 30 40 2\n2 1 0 0 0 0 0 0 7 b.png")
    with pytest.raises(FormatError, match=r"image 2 \(b\.png\) names camera 7"):
        read_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320\n7 WIDE 1 1 2\n")
    with pytest.raises(FormatError, match=r"cameras\.txt, line 1: camera 1: PINHOLE has 4 parameters"):
        read_colmap(tmp_path)


def test_dangling_track(tmp_path: Path) -> None:
    model, _ = views_model(3)
    model.points.tracks[1] = 2, 99
    write_colmap(tmp_path, model)
    with pytest.raises(FormatError, match="names feature 99 of image 2"):
        read_colmap(tmp_path)
