"""Archives that lead elsewhere or claim more than they hold."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from vg2gt.data import DataError
from vg2gt.io.arrays import load_npy, load_npz


def npy_header(shape: tuple[int, ...], kind: str = "<f4") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": kind, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


@pytest.mark.parametrize("count", [1 << 60, 1 << 50, 1 << 38])
def test_arrays_that_claim_more_than_they_hold(tmp_path: Path, count: int) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("depth.npy", npy_header((count,)) + bytes(64))
    (tmp_path / "a.npy").write_bytes(npy_header((1 << 20, count >> 20)) + bytes(64))
    with pytest.raises(DataError, match=r"cannot read .*a\.npz"):
        load_npz(tmp_path / "a.npz", "s", ("depth",))
    with pytest.raises(DataError, match=r"cannot read .*a\.npy"):
        load_npy(tmp_path / "a.npy", "s", (2, 2))
