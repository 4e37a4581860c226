"""transforms.json: round trips, conventions, real file, wrong shapes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.io import FormatError, Lens, Transforms, TransformsFrame, read_transforms, write_transforms

IDENTITY = np.eye(4).tolist()
POSED = '{"fl_x": 1, "frames": [{"file_path": "a", "transform_matrix": %s}]}'


def random_pose(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = quat_to_matrix(torch.from_numpy(rng.normal(size=4))).numpy()
    pose[:3, 3] = rng.normal(size=3)
    return pose


def random_transforms(shared_lens: bool, frames: int = 5) -> Transforms:
    rng = np.random.default_rng(0)

    def frame(i: int) -> TransformsFrame:
        own = 0 if shared_lens else i
        intrinsics = [[500.0 + own, 0, 320.25], [0, 510.5, 239.5], [0, 0, 1]]
        lens = Lens.from_intrinsics(intrinsics, (480, 640), {"k1": 0.1, "p2": -1e-3 * own})
        return TransformsFrame(f"images/{i}.png", random_pose(rng), lens, f"depth/{i}.png")

    return Transforms(tuple(frame(i) for i in range(frames)), "points.ply")


@pytest.mark.parametrize("shared_lens", [True, False])
@pytest.mark.parametrize("frames", [1, 5])
def test_round_trip(tmp_path: Path, shared_lens: bool, frames: int) -> None:
    before = random_transforms(shared_lens, frames)
    after = read_transforms(write_transforms(tmp_path / "transforms.json", before))
    for one, other in zip(before.frames, after.frames, strict=True):
        np.testing.assert_allclose(other.world_to_camera, one.world_to_camera, atol=1e-14)
        assert other.lens == one.lens
        assert (other.file_path, other.depth_file_path, other.mask_path) == (one.file_path, one.depth_file_path, None)
    assert after.ply_file_path == "points.ply"
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert ("fl_x" in content) == (shared_lens or frames == 1)
    assert ("fl_x" in content["frames"][0]) != ("fl_x" in content)


def test_axes_and_pixel_centres(tmp_path: Path) -> None:
    """A camera at (0, 0, 5) with OpenGL identity axes looks down -z and sees the origin 5 in front."""
    pose = np.eye(4)
    pose[2, 3] = 5
    content = {"fl_x": 100.0, "cx": 32.0, "cy": 24.0, "w": 64.0, "h": 48.0}
    content["frames"] = [{"file_path": "a.png", "transform_matrix": pose.tolist()}]
    (tmp_path / "t.json").write_text(json.dumps(content))
    (read,) = read_transforms(tmp_path / "t.json").frames
    np.testing.assert_array_equal(read.world_to_camera @ [0, 0, 0, 1], [0, 0, 5, 1])
    np.testing.assert_array_equal(read.world_to_camera @ [0, 1, 0, 1], [0, -1, 5, 1])
    np.testing.assert_array_equal(read.lens.intrinsics(), [[100, 0, 31.5], [0, 100, 23.5], [0, 0, 1]])
    assert not read.lens.is_distorted
    written = write_transforms(tmp_path / "back.json", Transforms((read,)))
    np.testing.assert_array_equal(json.loads(written.read_text())["frames"][0]["transform_matrix"], pose)


def test_field_of_view_and_missing_size(tmp_path: Path) -> None:
    frame = {"file_path": "./train/r_0", "transform_matrix": IDENTITY[:3]}
    (tmp_path / "t.json").write_text(json.dumps({"camera_angle_x": 2 * np.arctan(0.5), "frames": [frame]}))
    lens = read_transforms(tmp_path / "t.json").frames[0].lens
    np.testing.assert_allclose(lens.intrinsics((600, 800)), [[800, 0, 399.5], [0, 800, 299.5], [0, 0, 1]])
    with pytest.raises(ValueError, match="pass size"):
        lens.intrinsics()


def test_real_file(shared: Path, tmp_path: Path) -> None:
    fox = read_transforms(shared / "data" / "ingp_fox" / "transforms.json")
    assert len(fox.frames) == 67
    lens = fox.frames[0].lens
    assert (lens.width, lens.height) == (1080, 1920)
    assert lens.is_distorted
    assert lens.distortion == {"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575}
    np.testing.assert_allclose(lens.intrinsics(), [[1375.52, 0, 554.058], [0, 1374.49, 964.768], [0, 0, 1]])
    assert pytest.approx(lens.fl_x, rel=1e-5) == 1080 / 2 / np.tan(lens.camera_angle_x / 2)
    poses = np.stack([frame.world_to_camera for frame in fox.frames])
    again = read_transforms(write_transforms(tmp_path / "transforms.json", fox))
    np.testing.assert_allclose(np.stack([frame.world_to_camera for frame in again.frames]), poses, atol=1e-12)
    assert again.frames[0].lens == lens


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "should be an object"),
        ("{", "not valid JSON"),
        ("{}", "frames is missing"),
        ('{"frames": [3]}', r"frames\[0\] should be an object, got 3"),
        ('{"fl_x": "wide", "frames": []}', "fl_x is 'wide', expected a finite number"),
        ('{"w": 10.5, "frames": []}', "whole number of pixels"),
        ('{"frames": [{"file_path": "a"}]}', r"frames\[0\]\.fl_x is missing"),
        ('{"fl_x": 1, "frames": [{"file_path": "a"}]}', r"frames\[0\]\.transform_matrix is missing"),
        (POSED % "[[1], [2], [3]]", "3 or 4 rows of 4"),
        (POSED % "[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]", "not a rotation and a translation"),
    ],
)
def test_wrong_shapes_name_the_field(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(content)
    with pytest.raises(FormatError, match=message) as caught:
        read_transforms(path)
    assert str(path) in str(caught.value)


def test_pose_that_is_not_finite_is_kept_as_nan_and_not_written(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(POSED % "[[1, 0, 0, NaN], [0, 1, 0, 0], [0, 0, 1, 0]]")
    transforms = read_transforms(path)
    assert np.isnan(transforms.frames[0].world_to_camera).all()
    with pytest.raises(ValueError, match="finite"):
        write_transforms(tmp_path / "out.json", transforms)
    assert not (tmp_path / "out.json").exists()
