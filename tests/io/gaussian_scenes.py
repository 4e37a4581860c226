"""Small scenes of Gaussians for the formats' tests."""

import torch

from vg2gt.types import Cameras, Gaussians


def scene(count: int, degree: int = 0, seed: int = 0) -> Gaussians:
    """``count`` float32 Gaussians of all sizes, shapes, opacities and orientations, 2 to 4 units before the origin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    depth = 2 + 2 * torch.rand(count, generator=generator)
    sideways = (torch.rand(count, 2, generator=generator) - 0.5) * depth[:, None]
    return Gaussians(
        torch.cat((sideways, depth[:, None]), -1),
        normal(count, 4),
        0.08 * torch.exp(0.8 * normal(count, 3)),
        torch.sigmoid(1 + 2 * normal(count)),
        normal(count, (degree + 1) ** 2, 3) * (0.25 if degree else 1.0),
        torch.zeros(count, dtype=torch.int64),
    )


def views(size: tuple[int, int] = (40, 56)) -> Cameras:
    """Three views of such a scene, principal point in the middle of the image."""
    height, width = size
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    angle = torch.tensor([0.0, 0.2, -0.3])
    poses[0, :, 0, 0] = poses[0, :, 2, 2] = angle.cos()
    poses[0, :, 0, 2], poses[0, :, 2, 0] = angle.sin(), -angle.sin()
    poses[0, :, :3, 3] = torch.tensor([[0.0, 0, 0], [-0.5, 0.1, 0.2], [0.8, -0.1, 0.3]])
    intrinsics = torch.tensor([[45.0, 0, (width - 1) / 2], [0, 44.0, (height - 1) / 2], [0, 0, 1]])
    return Cameras(poses, intrinsics.repeat(1, 3, 1, 1), size)
