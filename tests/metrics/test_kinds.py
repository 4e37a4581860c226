import torch

from vg2gt.metrics import pixel_kinds
from vg2gt.types import Cameras


def test_a_wall_that_two_views_share() -> None:
    """The second camera is 10 pixels to the right, and the wall is further away in the lower quarter."""
    depth = torch.full((2, 32, 48), 2.0)
    depth[:, 24:] = 4.0
    depth[:, :4] = 0
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = -0.5
    intrinsics = torch.tensor([[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]).expand(1, 2, 3, 3)
    images = torch.full((2, 3, 32, 48), 0.5)
    images[..., 8:16, :] += 0.02 * torch.tensor([-1.0, 1.0]).repeat(24)
    images[..., 16:24, :] += 0.4 * torch.tensor([-1.0, 1.0]).repeat(24)
    kinds = pixel_kinds(images, depth, Cameras(poses[None], intrinsics, (32, 48)))
    assert torch.equal(torch.stack([*kinds.values()]).sum(0), (depth > 0).long())
    assert kinds["alone"][0, 6, :10].all()
    assert not kinds["alone"][0, 6, 10:].any()
    assert kinds["alone"][1, 6, 38:].all()
    assert not kinds["alone"][1, 6, :38].any()
    assert kinds["edge"][0, 21:27, 12:].all()
    assert not kinds["edge"][:, :20].any()
    shared = slice(14, 34)
    assert kinds["bare"][:, 4, shared].all()
    assert kinds["weak"][:, 11, shared].all()
    assert kinds["textured"][:, 19, shared].all()
