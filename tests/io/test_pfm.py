"""Portable float maps: byte orders, row order, damage."""

from pathlib import Path

import numpy as np
import pytest

from vg2gt.data import DataError
from vg2gt.io.pfm import read_pfm

DEPTH = np.arange(12, dtype=np.float32).reshape(3, 4) + 0.25


@pytest.mark.parametrize(("order", "scale"), [("<f4", "-1.0"), (">f4", "1.000000"), ("<f4", "-1e-2")])
def test_both_byte_orders_bottom_row_first(tmp_path: Path, order: str, scale: str) -> None:
    path = tmp_path / "a.pfm"
    path.write_bytes(f"Pf\n4 3\n{scale}\n".encode() + DEPTH[::-1].astype(order).tobytes())
    depth = read_pfm(path, "scan1", (3, 4))
    assert depth.dtype == np.float32
    assert np.array_equal(depth, DEPTH)
    with pytest.raises(DataError, match="is 4x3 pixels, but the recording's first one is 3x4"):
        read_pfm(path, "scan1", (4, 3))


ZEROS = b"\0" * 48


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PF\n4 3\n-1\n" + ZEROS * 3,
        b"Pf\n0 3\n-1\n",
        b"Pf\n4 3\nnan\n" + ZEROS,
        b"Pf\n4 3\n-1\n" + ZEROS[1:],
        b"Pf\n4 3\n-1\n" + ZEROS + b"\0",
        b"Pf\n999999 999999\n-1\n\0",
    ],
)
def test_damage_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.pfm"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.pfm of scene scan1"):
        read_pfm(path, "scan1")
    with pytest.raises(DataError, match=r"cannot read .*b\.pfm"):
        read_pfm(tmp_path / "b.pfm", "scan1")
