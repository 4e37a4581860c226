"""Other people's programs open our files. Each test skips where its program is not installed."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.io import read_gaussian_ply, read_spz, write_gaussian_ply, write_spz

pytestmark = pytest.mark.slow


def splat_transform(*arguments: Path | str) -> None:
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("needs splat-transform: npm install -g @playcanvas/splat-transform@3.7.0")
    done = subprocess.run([program, "-w", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_our_ply(tmp_path: Path, degree: int) -> None:
    before = scene(200, degree)
    path = write_gaussian_ply(tmp_path / "scene.ply", before)
    splat_transform(path, tmp_path / "theirs.ply")
    after = read_gaussian_ply(tmp_path / "theirs.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(after, name), getattr(read_gaussian_ply(path), name), rtol=0, atol=0)


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_and_we_decode_the_same_spz_alike(tmp_path: Path, degree: int) -> None:
    """Both ways: their decoder (Niantic's own) and ours on our file, and on theirs of the same scene."""
    before = scene(200, degree)
    before = replace(before, sh=torch.tanh(before.sh))
    ours, theirs = write_spz(tmp_path / "ours.spz", before), tmp_path / "theirs.spz"
    splat_transform("--spz-version", "3", write_gaussian_ply(tmp_path / "scene.ply", before), theirs)
    for file in (ours, theirs):
        splat_transform(file, tmp_path / "decoded.ply")
        one, other = read_spz(file), read_gaussian_ply(tmp_path / "decoded.ply")
        for name in ("means", "scales", "opacities", "sh"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=2e-5, atol=2e-5)
        quats = [torch.nn.functional.normalize(g.quats, dim=-1) for g in (one, other)]
        assert (quats[0] * quats[1]).sum(-1).abs().min() > 0.99999
        rows = torch.cdist(one.means, before.means).argmin(1)
        assert len(rows.unique()) == 200
        exact = before.select(rows)
        torch.testing.assert_close(one.means, exact.means, rtol=0, atol=4e-3)
        torch.testing.assert_close(one.opacities, exact.opacities, rtol=0, atol=1 / 200)
        torch.testing.assert_close(one.sh, exact.sh, rtol=0, atol=0.07)
