"""cameras.json: round trips, the renderer's cameras, refusal of everything else."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.io.gaussian_scenes import views
from tests.io.test_nerfstudio import random_pose
from vg2gt.io import FormatError, NamedCamera, named_cameras, read_cameras_json, write_cameras_json

K = np.array([[500.0, 0, 319.5], [0, 510, 239.25], [0, 0, 1]])


def mixed() -> list[NamedCamera]:
    rng = np.random.default_rng(0)
    sizes = [(640, 480), (480, 640), (64, 64)]
    return [
        NamedCamera(f"a/é {i}.png", *size, K + np.diag([i, 0, 0]), random_pose(rng)) for i, size in enumerate(sizes)
    ]


def test_round_trip_is_exact(tmp_path: Path) -> None:
    before = mixed()
    after = read_cameras_json(write_cameras_json(tmp_path / "cameras.json", before))
    for one, other in zip(before, after, strict=True):
        assert (one.name, one.width, one.height) == (other.name, other.width, other.height)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_views_become_records_and_back() -> None:
    cameras = views()
    records = named_cameras(cameras, ["a", "b", "c"])
    assert [record.name for record in records] == ["a", "b", "c"]
    back = records[1].cameras()
    assert back.size == cameras.size
    assert (back.world_to_camera == cameras.world_to_camera[:, 1:2]).all()
    assert (back.intrinsics == cameras.intrinsics[:, 1:2]).all()
    with pytest.raises(ValueError, match="3 views, 2 names"):
        named_cameras(cameras, ["a", "b"])


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", "", "name is '', expected"),
        ("width", 0, "width is 0, expected"),
        ("height", 2.5, "height is 2.5, expected"),
        ("width", 1_000_000, "width is 1000000, expected"),
        ("intrinsics", None, "intrinsics is missing, expected 3 rows"),
        ("intrinsics", [[1, 2], [3]], "expected 3 rows"),
        ("intrinsics", [[-5, 0, 1], [0, 5, 1], [0, 0, 1]], "positive focal"),
        ("intrinsics", [[5, 1, 1], [0, 5, 1], [0, 0, 1]], "no skew"),
        ("world_to_camera", (2 * np.eye(4)).tolist(), "not a rotation and a translation"),
        ("world_to_camera", [[float("nan")] * 4] * 4, "finite numbers"),
        ("world_to_camera", np.diag([1.0, 1, -1, 1]).tolist(), "mirroring"),
    ],
)
def test_wrong_fields_are_named(tmp_path: Path, field: str, value: object, message: str) -> None:
    path = write_cameras_json(tmp_path / "cameras.json", mixed())
    content = json.loads(path.read_text())
    content[1][field] = value
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=r"cameras\.json: \[1\]") as raised:
        read_cameras_json(path)
    assert message in str(raised.value)


@pytest.mark.parametrize("content", ["", "{}", "[3]", "[" * 100_000, '[{"id": 0, "img_name": "a", "rotation": []}]'])
def test_other_files_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(content)
    with pytest.raises(FormatError, match=r"cameras\.json"):
        read_cameras_json(path)
