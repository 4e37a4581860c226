""".splat files: layout, stated losses, damaged files."""

import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.io import FormatError, read_splat, write_splat


def displayable(count: int):
    """A scene whose colours lie in [0, 1]."""
    gaussians = scene(count)
    return replace(gaussians, sh=(torch.sigmoid(gaussians.sh) - 0.5) / DC)


@pytest.mark.parametrize("count", [0, 1, 300])
def test_round_trip_within_the_stated_losses(tmp_path: Path, count: int) -> None:
    before = displayable(count)
    path = write_splat(tmp_path / "scene.splat", before)
    assert path.stat().st_size == 32 * count
    after = read_splat(path)
    assert torch.equal(after.means, before.means)
    assert torch.equal(after.scales, before.scales)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1 / 509)
    torch.testing.assert_close(after.sh * DC, before.sh * DC, rtol=0, atol=1 / 509)
    relative = quat_to_matrix(after.quats).transpose(1, 2) @ quat_to_matrix(before.quats)
    cosine = (relative.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    angles = torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))
    assert angles.numel() == 0 or (angles.max() < 1.0 and angles.mean() < 0.6)
    # what was quantised once stays as it is
    assert write_splat(tmp_path / "again.splat", after).read_bytes()[:24] == path.read_bytes()[:24]
    assert torch.equal(read_splat(tmp_path / "again.splat").opacities, after.opacities)


def test_layout(tmp_path: Path) -> None:
    one = replace(
        displayable(1),
        quats=torch.tensor([[0.0, 0, -2, 0]]),
        opacities=torch.tensor([1.0]),
        sh=torch.tensor([[[(1 - 0.5) / DC, (0.2 - 0.5) / DC, -9.0]]]),
    )
    content = write_splat(tmp_path / "scene.splat", one).read_bytes()
    assert struct.unpack("<6f", content[:24]) == (*one.means[0].tolist(), *one.scales[0].tolist())
    assert list(content[24:]) == [255, 51, 0, 255, 128, 128, 0, 128]


def test_damage_is_named(tmp_path: Path) -> None:
    path = write_splat(tmp_path / "scene.splat", displayable(3))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(FormatError, match=r"scene\.splat: 95 bytes are not a multiple of 32"):
        read_splat(path)
    path.write_bytes(content[:44] + struct.pack("<f", -1.0) + content[48:])
    with pytest.raises(FormatError, match=r"byte 32: scales .* are negative"):
        read_splat(path)
    with pytest.raises(ValueError, match="quats must not be zero"):
        write_splat(path, replace(displayable(3), quats=torch.zeros(3, 4)))
