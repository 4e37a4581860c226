"""Frozen dataclasses passed between the parts of VG²GT.

Conventions (``docs/concepts/conventions.md``): OpenCV cameras (x right, y down, z forward), ``world_to_camera`` 4x4,
intrinsics in pixels with integer pixel centres (the centre of pixel (0, 0) is at (0, 0)), z-depth with 0 where invalid.
Letters in shapes: B scenes, V views, H x W pixels, P patches, M voxels, G Gaussians, K splits.
Sparse records (voxels, Gaussians) are packed over scenes: one row per element and a sorted ``batch`` index.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor

Record = TypeVar("Record", bound="TensorRecord")


@dataclass(frozen=True)
class TensorRecord:
    """Base class of all records: maps functions over all tensors, including nested records, tuples and mappings."""

    def map(self: Record, function: Callable[[Tensor], Tensor]) -> Record:
        """Returns a copy whose tensors are ``function(tensor)``; everything else is kept."""
        return replace(self, **{f.name: _map_value(getattr(self, f.name), function) for f in fields(self)})

    def to(self: Record, device: torch.device | str, non_blocking: bool = False) -> Record:
        """Returns a copy on ``device``; with ``non_blocking``, copies from page-locked memory do not block the host."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self: Record) -> Record:
        """Returns a copy in page-locked memory, which is faster to copy to a GPU."""
        return self.map(Tensor.pin_memory)

    def detach(self: Record) -> Record:
        """Returns a copy detached from the autograd graph."""
        return self.map(Tensor.detach)


def _map_value(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, TensorRecord):
        return value.map(function)
    if isinstance(value, tuple):
        return tuple(_map_value(item, function) for item in value)
    if isinstance(value, Mapping):
        return {key: _map_value(item, function) for key, item in value.items()}
    return value


def check_choice(name: str, value: object, choices: Any) -> None:
    """Raises ValueError, naming the choices, unless ``value`` is one of a tuple or of the values of a ``Literal``."""
    known = get_args(choices) or choices
    if value not in known:
        raise ValueError(f"{name} is {value!r}; choose one of {', '.join(known)}")


def check_ranges(options: object, prefix: str, *ranges: tuple[str, bool, str]) -> None:
    """Raises ValueError, naming the option and its value, unless all are in range.

    Args:
        options: holds the options as attributes.
        prefix: put before the names, such as ``refine.``.
        ranges: name of an option, whether it is in range, and the range in words.
    """
    for name, good, expected in ranges:
        if not good:
            raise ValueError(f"{prefix}{name} must be {expected}, got {getattr(options, name)}")


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Pinhole cameras of B scenes with V views each.

    Attributes:
        world_to_camera: ``[B, V, 4, 4]`` rigid OpenCV transforms; translation in scene units.
        intrinsics: ``[B, V, 3, 3]`` in pixels, integer pixel centres.
        size: image ``(height, width)`` in pixels.
    """

    world_to_camera: Tensor
    intrinsics: Tensor
    size: tuple[int, int]

    def select(self, views: Tensor | slice) -> Cameras:
        """Returns the cameras of some views; ``views`` indexes the V axis."""
        return Cameras(self.world_to_camera[:, views], self.intrinsics[:, views], self.size)

    def scene(self, index: int) -> Cameras:
        """Returns the cameras of one scene, keeping the B axis (B = 1)."""
        return self.map(lambda tensor: tensor[index : index + 1])


@dataclass(frozen=True)
class Hints(TensorRecord):
    """Data about the views that a backend can use besides the images (the oracle needs it, DA3 can use the cameras).

    Attributes:
        depth: ``[B, V, H, W]`` z-depth in the data's unit, 0 = invalid; None if unknown.
        cameras: cameras in any world frame; None if unknown.
        scene_key: one name per scene; seeds simulated noise.
        frame_ids: ``[B, V]`` int64 frame numbers; seed simulated noise.
        depth_range: ``[B, 2]`` z-depth (near, far) that contains nearly everything the views see, for example from
            sparse structure-from-motion points, in the unit of the cameras' translations; None if unknown. The backends
            in the package do not need it.
        mask: ``[B, V, H, W]`` in [0, 1], weight of each pixel (alpha, mask images); None: all 1.
    """

    depth: Tensor | None = None
    cameras: Cameras | None = None
    scene_key: tuple[str, ...] = ()
    frame_ids: Tensor | None = None
    depth_range: Tensor | None = None
    mask: Tensor | None = None


@dataclass(frozen=True)
class Batch(TensorRecord):
    """B scenes with V views each; the first ``num_context`` views are the input, the rest are held-out targets.

    Attributes:
        images: ``[B, V, 3, H, W]`` in [0, 1].
        depth: ``[B, V, H, W]`` z-depth in the data's unit, 0 = invalid.
        cameras: ground-truth cameras, world frame of the data.
        frame_ids: ``[B, V]`` int64.
        scene: one name per scene.
        num_context: number of input views, 1 <= num_context <= V.
        mask: ``[B, V, H, W]`` in [0, 1], weight of each pixel (alpha, mask images); None: all 1.
    """

    images: Tensor
    depth: Tensor
    cameras: Cameras
    frame_ids: Tensor
    scene: tuple[str, ...]
    num_context: int
    mask: Tensor | None = None

    def views(self, views: slice) -> Batch:
        """Returns the batch restricted to a slice of its views, all as context."""
        every = {name: getattr(self, name) for name in ("images", "depth", "frame_ids", "mask")}
        some = {name: value[:, views] for name, value in every.items() if value is not None}
        return replace(self, **some, cameras=self.cameras.select(views), num_context=some["images"].shape[1])

    def single(self, index: int) -> Batch:
        """Returns one scene of the batch (B = 1)."""
        rows = slice(index, index + 1)
        return replace(self.map(lambda tensor: tensor[rows]), scene=self.scene[rows])

    @property
    def context(self) -> Batch:
        """The input views."""
        return self.views(slice(0, self.num_context))

    @property
    def target(self) -> Batch:
        """The held-out views (possibly none)."""
        return self.views(slice(self.num_context, None))

    @property
    def hints(self) -> Hints:
        """The data about all views of this batch that a backend can use."""
        return Hints(self.depth, self.cameras, self.scene, self.frame_ids, mask=self.mask)


@dataclass(frozen=True)
class Tokens(TensorRecord):
    """Output of the frozen backbone, in the form its heads expect.

    Attributes:
        patch: one ``[B, V, P, D]`` tensor per tapped layer, in tap order; P = grid[0] * grid[1], row major.
        camera: ``[B, V, Dc]`` camera token of the last tap.
        grid: size of the patch grid ``(rows, columns)``.
        size: image ``(height, width)`` in pixels.
        state: anything else the backend's ``decode`` needs; opaque to all other code.
    """

    patch: tuple[Tensor, ...]
    camera: Tensor
    grid: tuple[int, int]
    size: tuple[int, int]
    state: Mapping[str, Any] = field(default_factory=dict)

    def with_patch(self, patch: tuple[Tensor, ...]) -> Tokens:
        """Returns a copy with other patch tokens; the camera token never changes."""
        return replace(self, patch=patch)


@dataclass(frozen=True)
class Geometry(TensorRecord):
    """Decoded geometry of V views.

    Attributes:
        depth: ``[B, V, H, W]`` z-depth, 0 = invalid, in the unit of the cameras' translations.
        depth_conf: ``[B, V, H, W]`` confidence > 0 (larger is better).
        cameras: predicted cameras.
        scale: ``[B]`` metres per unit where the backend predicts them, else 1.
    """

    depth: Tensor
    depth_conf: Tensor
    cameras: Cameras
    scale: Tensor

    def where(self, keep: Tensor | None) -> Geometry:
        """Returns the geometry with depth set to 0 where ``keep`` ``[B, V, H, W]`` is false; None keeps all depth."""
        return self if keep is None else replace(self, depth=torch.where(keep, self.depth, 0.0))


@dataclass(frozen=True)
class VoxelMoments(TensorRecord):
    """Second moments of the points in M voxels, without gradient; lengths in cells.

    Attributes:
        spread: ``[M, 3, 3]`` covariance of the points' positions.
        cross: ``[M, 3 (position), 3 (colour)]`` covariance of position and colour.
        facing: ``[M, 3]`` unit vector towards the mean centre of the cameras that saw the points.
        pixel: ``[M]`` mean side of a pixel at the points' depth.
        normal: ``[M, 3]`` unit normal of the surface through the cell, facing the cameras.
    """

    spread: Tensor
    cross: Tensor
    facing: Tensor
    pixel: Tensor
    normal: Tensor


@dataclass(frozen=True)
class Voxels(TensorRecord):
    """Occupied voxels of B scenes, packed and sorted by scene.

    Attributes:
        features: ``[M, C]``.
        colors: ``[M, 3]`` confidence-weighted mean image colour in [0, 1].
        grid: ``[M, 3]`` int64 world-anchored cell index, ``floor(x / voxel_size)``.
        batch: ``[M]`` int64 scene index, sorted.
        confidence: ``[M]`` smallest point confidence inside (paper, eqn voxelfeature).
        count: ``[M]`` number of points inside, as a float.
        centroid: ``[M, 3]`` confidence-weighted mean position.
        voxel_size: ``[B]`` edge length in scene units.
        moments: second moments of the points; None unless requested.
    """

    features: Tensor
    colors: Tensor
    grid: Tensor
    batch: Tensor
    confidence: Tensor
    count: Tensor
    centroid: Tensor
    voxel_size: Tensor
    moments: VoxelMoments | None = None

    @property
    def centers(self) -> Tensor:
        """``[M, 3]`` cell centres in scene units."""
        return (self.grid.to(self.centroid.dtype) + 0.5) * self.voxel_size[self.batch, None]


@dataclass(frozen=True)
class Gaussians(TensorRecord):
    """Gaussian primitives of B scenes, packed and sorted by scene.

    Attributes:
        means: ``[G, 3]`` world position in scene units.
        quats: ``[G, 4]`` rotation, wxyz (renderers normalise).
        scales: ``[G, 3]`` standard deviations > 0 in scene units.
        opacities: ``[G]`` in (0, 1).
        sh: ``[G, (L + 1)^2, 3]`` real spherical-harmonic colour coefficients, world frame; colour = 1/2 + sum.
        batch: ``[G]`` int64 scene index, sorted.
        background: ``[B, 3]`` colour in [0, 1] of rays that hit no Gaussian; None is black.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    batch: Tensor
    background: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Tensor | slice) -> Gaussians:
        """Returns some of the Gaussians; ``rows`` are sorted indices, a slice or a ``[G]`` bool mask."""
        names = [each.name for each in fields(self) if each.name != "background"]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def joined(self, more: Gaussians) -> Gaussians:
        """Returns one scene's Gaussians followed by ``more``, of equal or lower SH degree; keeps its background."""
        padded = torch.nn.functional.pad(more.sh, (0, 0, 0, self.sh.shape[1] - more.sh.shape[1]))
        more = replace(more, sh=padded)
        names = [each.name for each in fields(self) if each.name != "background"]
        return replace(self, **{name: torch.cat((getattr(self, name), getattr(more, name))) for name in names})

    def scene(self, index: int) -> Gaussians:
        """Returns one scene's Gaussians, with ``batch`` set to 0."""
        bounds = torch.searchsorted(self.batch, torch.tensor([index, index + 1], device=self.batch.device))
        own = self.select(slice(int(bounds[0]), int(bounds[1])))
        background = None if self.background is None else self.background[index : index + 1]
        return replace(own, batch=torch.zeros_like(own.batch), background=background)


@dataclass(frozen=True)
class Footprints(TensorRecord):
    """Gaussians on the images, for densification: each in the V views of its own scene. All 0 where not visible.

    Attributes:
        means2d: ``[V, G, 2]`` projected means in pixels: a leaf of the autograd graph, whose ``grad`` the backward pass
            sets.
        radii: ``[V, G]`` half the longer side, in pixels, of the box of all places with an alpha of at least 1/255.
        absgrad: ``[V, G, 2]`` sum over pixels of the absolute values of each pixel's share in the gradient of
            ``means2d``; backward passes add to it. None if not asked for.
    """

    means2d: Tensor
    radii: Tensor
    absgrad: Tensor | None = None

    def select(self, views: slice = slice(None), gaussians: slice = slice(None)) -> Footprints:
        """Returns those of some views and Gaussians, in the same memory."""
        return self.map(lambda tensor: tensor[views, gaussians])


@dataclass(frozen=True)
class Render(TensorRecord):
    """Rendered views.

    Attributes:
        color: ``[B, V, 3, H, W]``, background blended in.
        depth: ``[B, V, H, W]`` z-depth, 0 where the ray has none (a hole).
        normal: ``[B, V, 3, H, W]`` blended camera-frame normals (not unit length), facing the camera.
        alpha: ``[B, V, H, W]`` accumulated opacity in [0, 1].
        footprints: the Gaussians on the images, on the device that rendered; None if not asked for.
    """

    color: Tensor
    depth: Tensor
    normal: Tensor
    alpha: Tensor
    footprints: Footprints | None = None


@dataclass(frozen=True)
class Decoded(TensorRecord):
    """Geometry of the context views, in scene units and the frame of view 0.

    Attributes:
        initial: the frozen backbone's geometry, before enhancement.
        geometry: geometry decoded again from the enhanced tokens; ``initial`` if there is no enhancement.
        unit: ``[B]`` scene units per unit of the backend's raw output (1 where nothing was rescaled).
    """

    initial: Geometry
    geometry: Geometry
    unit: Tensor


@dataclass(frozen=True)
class Prediction(Decoded):
    """Output of one forward pass.

    Attributes:
        voxels: refined fine voxels; None for models without voxels.
        gaussians: the Gaussian scene.
        supported: ``[B, V, H, W]`` bool, pixels whose depth enters the scene; None: all pixels with depth.
    """

    voxels: Voxels | None
    gaussians: Gaussians
    supported: Tensor | None = None

    @property
    def surface(self) -> Geometry:
        """The geometry with only the depth that enters the scene."""
        return self.geometry.where(self.supported)
