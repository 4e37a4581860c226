"""Other people's programs open our files. Each test skips where its program is not installed."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.io.gaussian_scenes import scene
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io import read_gaussian_ply, write_gaussian_ply, write_point_ply, write_splat

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


def test_splat_transform_reads_and_converts_our_splat(tmp_path: Path) -> None:
    before = scene(200)
    before = replace(before, sh=(torch.sigmoid(before.sh) - 0.5) / DC)
    splat_transform(write_splat(tmp_path / "scene.splat", before), tmp_path / "theirs.ply")
    after = read_gaussian_ply(tmp_path / "theirs.ply")
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=0)
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(after.sh * DC, before.sh * DC, rtol=0, atol=1 / 500)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1 / 250)
    unit, other = (torch.nn.functional.normalize(g.quats, dim=-1) for g in (before, after))
    assert (unit * other).sum(-1).abs().min() > 0.9999


def test_trimesh_loads_both_kinds_of_ply(tmp_path: Path) -> None:
    before = scene(50)
    rgb = np.random.default_rng(0).integers(0, 256, (50, 3)).astype(np.uint8)
    points = trimesh.load(write_point_ply(tmp_path / "points.ply", before.means.numpy(), rgb))
    assert isinstance(points, trimesh.PointCloud)
    np.testing.assert_array_equal(points.vertices, before.means.numpy())
    np.testing.assert_array_equal(points.colors[:, :3], rgb)
    gaussians = trimesh.load(write_gaussian_ply(tmp_path / "scene.ply", before))
    assert isinstance(gaussians, trimesh.PointCloud)
    np.testing.assert_array_equal(gaussians.vertices, before.means.numpy())
