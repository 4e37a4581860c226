"""Points as PLY."""

from pathlib import Path

import numpy as np
import pytest

from vg2gt.io import write_point_ply


@pytest.mark.parametrize("count", [0, 50])
def test_points_round_trip(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(count, 3)).astype(np.float32), rng.integers(0, 256, (count, 3)).astype(np.uint8)
    for colors, expected in ((rgb, rgb), (None, np.full((count, 3), 128))):
        path = write_point_ply(tmp_path / "points.ply", xyz, colors)
        head, body = path.read_bytes().split(b"end_header\n")
        lines = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
        assert lines == [["float", axis] for axis in "xyz"] + [["uchar", c] for c in ("red", "green", "blue", "alpha")]
        table = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1")])
        np.testing.assert_array_equal(table["xyz"], xyz)
        np.testing.assert_array_equal(table["rgb"], expected)


def test_points_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    for message, xyz, colors in (
        (r"positions must be \[N, 3\]", np.zeros((4, 2)), None),
        (r"uint8 \[N, 3\], got \[4, 3\] and float64", np.zeros((4, 3)), np.zeros((4, 3))),
        ("positions must be finite", np.full((4, 3), np.nan), None),
    ):
        with pytest.raises(ValueError, match=message):
            write_point_ply(tmp_path / "points.ply", xyz, colors)
    assert not (tmp_path / "points.ply").exists()
