"""Other people's programs open our files. Each test skips where its program is not installed."""

import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.io import read_gaussian_ply, write_gaussian_ply

pytestmark = pytest.mark.slow


def splat_transform(*arguments: Path | str) -> None:
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("needs splat-transform: npm install -g @playcanvas/splat-transform")
    done = subprocess.run([program, "-w", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_and_converts_our_ply(tmp_path: Path, degree: int) -> None:
    before = scene(200, degree)
    path = write_gaussian_ply(tmp_path / "scene.ply", before)
    splat_transform(path, tmp_path / "theirs.ply")
    after = read_gaussian_ply(tmp_path / "theirs.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(after, name), getattr(read_gaussian_ply(path), name), rtol=0, atol=0)
    splat_transform(path, tmp_path / "scene.compressed.ply")
    assert (tmp_path / "scene.compressed.ply").stat().st_size < path.stat().st_size
    packed, order = read_gaussian_ply(tmp_path / "scene.compressed.ply"), []
    for mean in packed.means:  # it sorts what it compresses
        order.append(int((after.means - mean).norm(dim=-1).argmin()))
    assert sorted(order) == list(range(200))
    torch.testing.assert_close(packed.means, after.means[order], rtol=0, atol=4e-3)
    torch.testing.assert_close(packed.scales, after.scales[order], rtol=0.02, atol=0)
    torch.testing.assert_close(packed.opacities, after.opacities[order], rtol=0, atol=1 / 200)
    torch.testing.assert_close(packed.sh, after.sh[order], rtol=0, atol=0.05)
    unit = torch.nn.functional.normalize(after.quats[order], dim=-1)
    assert (packed.quats * unit).sum(-1).abs().min() > 0.999
