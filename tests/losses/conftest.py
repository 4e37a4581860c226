"""A small scene with exact ground truth, from which every loss test makes its own prediction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from vg2gt.geometry.cameras import relative_to_first, scale_translations
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.types import Batch, Cameras, Gaussians, Geometry, Prediction, Render, Voxels


@dataclass(frozen=True)
class Sample:
    """A batch and a prediction that is exact but for the unit: ground truth = ``unit`` times the prediction."""

    batch: Batch
    prediction: Prediction
    rendered: Render
    views: Tensor
    cameras: Cameras

    @property
    def inputs(self) -> tuple[Prediction, Batch, Render, Tensor, Cameras]:
        return self.prediction, self.batch, self.rendered, self.views, self.cameras

    def with_depth(self, depth: Tensor, depth_conf: Tensor | None = None) -> Sample:
        """The same sample with another enhanced depth."""
        geometry = self.prediction.geometry
        conf = geometry.depth_conf if depth_conf is None else depth_conf
        geometry = replace(geometry, depth=depth, depth_conf=conf)
        return replace(self, prediction=replace(self.prediction, geometry=geometry))

    def with_initial(self, depth: Tensor) -> Sample:
        """The same sample with another depth before enhancement."""
        return replace(self, prediction=replace(self.prediction, initial=replace(self.prediction.initial, depth=depth)))

    def with_truth(self, depth: Tensor) -> Sample:
        """The same sample with another true depth."""
        return replace(self, batch=replace(self.batch, depth=depth))

    def with_render(self, **changes: Tensor) -> Sample:
        """The same sample with other renders."""
        return replace(self, rendered=replace(self.rendered, **changes))


def random_cameras(scenes: int, views: int, size: tuple[int, int], generator: torch.Generator) -> Cameras:
    quats = 0.1 * torch.randn(scenes, views, 4, generator=generator, dtype=torch.float64)
    quats[..., 0] = 1
    poses = torch.eye(4, dtype=torch.float64).repeat(scenes, views, 1, 1)
    poses[..., :3, :3] = quat_to_matrix(quats)
    poses[..., :3, 3] = 0.5 * torch.randn(scenes, views, 3, generator=generator, dtype=torch.float64)
    height, width = size
    intrinsics = torch.tensor([[0.9 * width, 0, width / 2 - 0.7], [0, 0.8 * width, height / 2 - 0.3], [0, 0, 1]])
    return Cameras(poses, intrinsics.double().repeat(scenes, views, 1, 1), size)


def make_sample(
    scenes: int = 1,
    views: int = 4,
    num_context: int = 3,
    size: tuple[int, int] = (24, 32),
    unit: float = 2.5,
    seed: int = 0,
    rendered: tuple[int, ...] = (3, 1),
    dtype: torch.dtype = torch.float64,
) -> Sample:
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    cameras = random_cameras(scenes, views, size, generator)
    x = torch.linspace(0, 5, width, dtype=torch.float64)
    y = torch.linspace(0, 4, height, dtype=torch.float64)[:, None]
    phase = 6 * torch.rand(scenes, views, 1, 1, generator=generator, dtype=torch.float64)
    depth = 3 + 0.4 * torch.sin(x + phase) + 0.3 * torch.cos(y - phase)
    images = torch.rand(scenes, views, 3, height, width, generator=generator, dtype=torch.float64)
    batch = Batch(
        images,
        depth,
        cameras,
        torch.arange(views).repeat(scenes, 1),
        tuple(f"scene_{i}" for i in range(scenes)),
        num_context,
    )
    factor = torch.full((scenes,), 1 / unit, dtype=torch.float64)
    predicted = scale_translations(relative_to_first(cameras), factor)
    context = slice(0, num_context)
    conf = 1.5 + torch.rand(scenes, num_context, height, width, generator=generator, dtype=torch.float64)
    geometry = Geometry(depth[:, context] / unit, conf, predicted.select(context), factor)
    shown = torch.tensor(rendered)
    normals, _ = normals_from_depth(depth[:, shown], cameras.intrinsics[:, shown], edge_threshold=1e9)
    render = Render(images[:, shown], depth[:, shown] / unit, normals, torch.ones_like(depth[:, shown]))
    empty, index = torch.zeros(0), torch.zeros(0, dtype=torch.long)
    voxels = Voxels(empty, empty, index, index, empty, empty, empty, empty)
    gaussians = Gaussians(empty, empty, empty, empty, empty, index)
    prediction = Prediction(geometry, geometry, factor, voxels, gaussians)

    def convert(tensor: Tensor) -> Tensor:
        return tensor.to(dtype) if tensor.is_floating_point() else tensor

    return Sample(
        batch.map(convert), prediction.map(convert), render.map(convert), shown, predicted.select(shown).map(convert)
    )


@pytest.fixture(scope="session")
def sample() -> Callable[..., Sample]:
    """Makes samples; see :func:`make_sample`."""
    return make_sample
