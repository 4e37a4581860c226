"""The whole method in one forward pass (paper, Method).

images -> frozen backbone -> tokens -> frozen heads -> depth, confidence, cameras
                               |                            |
                               +<---- coarse voxels <-------+
                               |
                     enhanced tokens -> the same frozen heads -> geometry
                               |                                    |
                               +------------> fine voxels <---------+
                                                  |
                                      self-splitting Gaussian head -> Gaussians
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from backends.base import Backend
from backends.cache import TokenCache
from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import focal_lengths, relative_to_first, scale_translations
from vg2gt.memory import note_sizes
from vg2gt.method.additions.visibility import Support, ViewCheck
from vg2gt.profiling import stage
from vg2gt.types import Cameras, Decoded, Gaussians, Geometry, Hints, Prediction, Tokens, Voxels

Background = Literal["mean", "black"]
ScaleSource = Literal["metric", "focal", "normalize", "groundtruth"]
BACKBONE_PREFIX = "backend."
SEEN_WEIGHT = 0.01  # in the background's colour, of a pixel with a depth against one without
CANONICAL_FOCAL = 300.0  # appendix A.1: d_metric = f * d_net / 300


class SceneScale:
    """Fixes the unit of a scene before anything is voxelised (paper, appendix A.1): one factor a scene.

    Args:
        source: ``metric`` (the backend knows metres), ``focal`` (mean focal length / 300, as the paper does with DA3),
            ``normalize`` (the median depth of the scene becomes ``median_depth``) or ``groundtruth`` (training only:
            the weighted-median alignment to the depth in the hints).
        median_depth: the median depth after ``normalize``, in scene units.

    Raises:
        ValueError: if the source is unknown.
    """

    def __init__(self, source: ScaleSource = "normalize", median_depth: float = 1.0) -> None:
        if source not in get_args(ScaleSource):
            raise ValueError(f"model.scale.source is {source!r}; choose one of {', '.join(get_args(ScaleSource))}")
        self.source = source
        self.median_depth = median_depth

    def __call__(self, geometry: Geometry, hints: Hints | None) -> Tensor:
        """Returns scene units per unit of ``geometry``, ``[B]``, detached."""
        if self.source == "metric":
            return geometry.scale.detach()
        if self.source == "focal":
            focal = focal_lengths(geometry.cameras.intrinsics)
            return focal.mean((1, 2)).detach() / CANONICAL_FOCAL
        if self.source == "groundtruth":
            if hints is None or hints.depth is None:
                raise ValueError("model.scale.source=groundtruth needs the data's depth; use normalize without it")
            return fit_depth_scale(geometry.depth, hints.depth, hints.depth > 0).nan_to_num(1.0)
        return torch.stack([self._normalize(depth) for depth in geometry.depth.detach()])

    def _normalize(self, depth: Tensor) -> Tensor:
        valid = depth[depth > 0]
        return self.median_depth / valid.median() if valid.numel() else depth.new_ones(())


class Reconstructor(nn.Module, ABC):
    """What training, evaluation and commands know of a model: images in, a Gaussian scene out, on a frozen backbone.

    Args:
        backend: the frozen visual foundation model.
        scale: fixes the scene unit.
        background: what rays see that meet no Gaussian: the ``mean`` colour of the pixels without a depth, or of all
            where there are none, or ``black``.
        visibility: not in the paper: decides by what other views see which pixels' depth the scene is made of; None
            takes all.

    Raises:
        ValueError: if the scale is to be metric and the backend is not, or the background is unknown.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        super().__init__()
        if background not in get_args(Background):
            raise ValueError(f"model.background is {background!r}; choose one of {', '.join(get_args(Background))}")
        if scale.source == "metric" and not backend.is_metric:
            raise ValueError(
                f"model.scale.source=metric needs a backend that knows metres, {backend.name} does not: "
                "use model.scale.source=normalize or focal"
            )
        backend.freeze()  # a subclass may have added layers after its parent's constructor froze those before
        self.backend = backend
        self.scale = scale
        self.background: Background = background
        self.visibility = visibility
        self.token_cache: TokenCache | None = None  # set where view sets come again

    @abstractmethod
    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """Reconstructs B scenes.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1]; H and W multiples of the backend's patch size.
            hints: what the data knows, for backends that need it.
            generator: draws whatever is random while training.

        Returns:
            Geometry and Gaussians in scene units and in the frame of view 0.
        """

    def read_views(
        self, images: Tensor, hints: Hints | None, unit: Tensor | None = None
    ) -> tuple[Tokens, Geometry, Tensor]:
        """Runs the frozen backbone (paper, eqn preliminary_vggt).

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: what the data knows of these views.
            unit: ``[B]`` scene units per unit of the backbone; None: the model's own.

        Returns:
            Its tokens, its geometry in scene units and in the frame of view 0, and the unit ``[B]``.
        """
        scenes, views, _, height, width = images.shape
        note_sizes({f"images of {height}x{width} in {scenes} scene{'s' * (scenes > 1)}": scenes * views}, first=True)
        tokens, raw = self.run_backbone(images, hints)
        raw = masked(raw, hints)
        unit = self.scale(raw, hints) if unit is None else unit
        return tokens, _to_scene_frame(raw, unit), unit

    def run_backbone(self, images: Tensor, hints: Hints | None) -> tuple[Tokens, Geometry]:
        """The backbone's tokens and the geometry that its heads decode of them; from the cache where there is one.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: what the data knows of these views.
        """
        if self.token_cache is not None and self.backend.frozen:
            with stage("encode"):
                return self.token_cache.read(self.backend, images, hints)
        with stage("encode"):
            tokens = self.backend.encode(images, hints)
        with stage("decode"), torch.no_grad():
            return tokens, self.backend.decode(tokens)

    def predict_cameras(self, images: Tensor, hints: Hints | None) -> Cameras:
        """The backbone's raw cameras alone, from the cache where there is one.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: what the data knows of these views.
        """
        with stage("cameras"):
            if self.token_cache is not None and self.backend.frozen:
                return self.token_cache.cameras(self.backend, images, hints)
            return self.backend.predict_cameras(images, hints)

    def support(self, geometry: Geometry, hints: Hints | None) -> Support | None:
        """What the views say of each other's depth; None where nothing is checked."""
        if self.visibility is None:
            return None
        with stage("visibility"):
            return self.visibility(geometry, None if hints is None else hints.frame_ids)

    def with_background(self, gaussians: Gaussians, images: Tensor, depth: Tensor) -> Gaussians:
        """Sets what rays see that meet no Gaussian: the colour of pixels without depth (the sky), else the mean colour.

        Args:
            gaussians: of B scenes.
            images: ``[B, V, 3, H, W]`` that they were made of.
            depth: ``[B, V, H, W]`` the backbone's, 0 = invalid.
        """
        if self.background == "black":
            return gaussians
        total, weight = background_sums(images, depth)
        return replace(gaussians, background=total / weight)

    def trained_parameters(self) -> list[nn.Parameter]:
        """The parameters that training changes: everything but a frozen backbone."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def trained_state(self) -> dict[str, Tensor]:
        """What a checkpoint holds of the model: the state of everything but a frozen backbone."""
        return {name: value for name, value in self.state_dict().items() if self._stored(name)}

    def _stored(self, name: str) -> bool:
        return not (self.backend.frozen and name.startswith(BACKBONE_PREFIX))

    def load_trained(self, state: Mapping[str, Tensor], backend: Mapping[str, Any] | None) -> None:
        """Loads the trained part, which must be whole; a backbone that was frozen in training is not in it.

        Args:
            state: as :meth:`trained_state` gave it.
            backend: identity of the backbone it was trained on.

        Raises:
            ValueError: if it was trained on another backbone, or does not fit this model; nothing is loaded then.
        """
        self.check_backend(backend)
        present = {name: value.shape for name, value in self.trained_state().items()}
        stored = {name: value.shape for name, value in state.items() if self._stored(name)}
        if stored != present:
            wrong = sorted(name for name in stored.keys() | present.keys() if stored.get(name) != present.get(name))
            raise ValueError(
                f"the checkpoint does not fit this model, first in model.{wrong[0]} (stored {stored.get(wrong[0])}, "
                f"here {present.get(wrong[0])}): use the model options it was trained with, or init_from= to start "
                "from the weights that fit"
            )
        self.load_state_dict(state, strict=False)

    def check_backend(self, stored: Mapping[str, Any] | None) -> None:
        """Refuses weights that were trained on another backbone.

        Raises:
            ValueError: naming both.
        """
        present = dict(self.backend.identity())
        if stored != present:
            raise ValueError(
                f"the checkpoint was trained on backbone {stored}, this run uses {present}: choose the same backend= "
                "and the same weights, or start a new run from it with init_from="
            )


class VG2GT(Reconstructor):
    """Feed-forward Gaussian reconstruction on a frozen backbone (paper, eqn propose).

    Args:
        backend: the frozen visual foundation model.
        scale: fixes the scene unit.
        coarse: makes the coarse-level feature enhancement from ``token_dims`` and ``patch_size``; None leaves it out
            (ablation w/o Coarse): the geometry is then the backbone's.
        fine: makes the fine-level voxel module from ``token_dims`` and ``patch_size``.
        gaussians: makes the self-splitting Gaussian head from ``in_channels``.
        keep_scale: the enhanced depth keeps the scale of the backbone's, see :func:`with_scale_of`.
        background: see :class:`Reconstructor`.
        visibility: see :class:`Reconstructor`; it checks the enhanced geometry before the fine level.

    Raises:
        ValueError: if the scale is to be metric and the backend is not, or the background is unknown.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        coarse: Callable[..., nn.Module] | None,
        fine: Callable[..., nn.Module],
        gaussians: Callable[..., nn.Module],
        keep_scale: bool = True,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        super().__init__(backend, scale, background, visibility)
        dims, patch = backend.token_dims, backend.patch_size
        self.keep_scale = keep_scale
        self.coarse = coarse(token_dims=dims, patch_size=patch) if coarse else None
        self.fine = fine(token_dims=dims, patch_size=patch)
        self.gaussians = gaussians(in_channels=self.fine.out_channels)

    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """Reconstructs B scenes.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1]; H and W multiples of the backend's patch size.
            hints: what the data knows, for backends that need it.
            generator: draws the serialisation order of the coarse module, and voxel sizes, while training.

        Returns:
            Geometry before and after enhancement, voxels and Gaussians, in scene units and in the frame of view 0.
        """
        # coarse level: images [B, V, 3, H, W] to enhanced tokens [B, V, P, D] and depth [B, V, H, W]
        tokens, decoded = self.enhance(images, hints, generator)
        # ours: pixels that other views do not contradict [B, V, H, W]
        support = self.support(decoded.geometry, hints)
        keep, coarsen = (None, None) if support is None else (support.keep, support.coarsen)
        # fine level: pixels to M voxels with features [M, C]
        with stage("fine"):
            voxels: Voxels = self.fine(tokens, decoded.geometry.where(keep), images, coarsen, generator)
        # every voxel splits into K Gaussians: [M * K]
        with stage("gaussians"):
            gaussians = self.with_background(self.gaussians(voxels), images, decoded.initial.depth)
        return Prediction(decoded.initial, decoded.geometry, decoded.unit, voxels, gaussians, keep)

    def enhance(
        self,
        images: Tensor,
        hints: Hints | None = None,
        generator: torch.Generator | None = None,
        unit: Tensor | None = None,
    ) -> tuple[Tokens, Decoded]:
        """The part of the method up to the enhanced geometry (paper, Coarse-level).

        Args:
            images: as for :meth:`forward`.
            hints: as for :meth:`forward`.
            generator: as for :meth:`forward`.
            unit: ``[B]`` scene units per unit of the backbone; None: the model's own.

        Returns:
            The enhanced tokens, and geometry before and after enhancement.
        """
        # frozen backbone: tokens [B, V, P, D], depth and cameras
        tokens, initial, unit = self.read_views(images, hints, unit)
        if self.coarse is None:
            return tokens, Decoded(initial, initial, unit)
        # points to voxels, PTv3, back to tokens, which the same frozen heads decode again
        with stage("coarse"):
            tokens = self.coarse(tokens, initial, generator=generator)
        with stage("decode_again"):
            again = masked(self.backend.decode(tokens), hints)
        # The camera token is untouched, so the cameras are the backbone's: decoded once, used throughout.
        depth = again.depth * unit[:, None, None, None]
        depth = depth if not self.keep_scale else with_scale_of(initial, depth)
        return tokens, Decoded(initial, replace(initial, depth=depth, depth_conf=again.depth_conf), unit)


def background_sums(images: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted sum of the colours ``[B, 3]`` that a scene's background is the mean of, and the weights' ``[B, 1]``."""
    weight = torch.where(depth > 0, SEEN_WEIGHT, 1.0)[:, :, None]  # [B, V, 1, H, W]
    return (weight * images.detach().float()).sum((1, 3, 4)), weight.sum((1, 3, 4))


def masked(geometry: Geometry, hints: Hints | None) -> Geometry:
    """Takes depth away where a mask says that pixels do not count, and confidence as far as they count less."""
    if hints is None or hints.mask is None:
        return geometry
    kept = geometry.where(hints.mask > 0.5)
    return replace(kept, depth_conf=geometry.depth_conf * hints.mask.clamp(min=1e-3))


def with_scale_of(initial: Geometry, depth: Tensor) -> Tensor:
    """Takes the one factor per scene between enhanced and initial depth out of the enhanced depth, differentiably.

    The cameras stay the backbone's, so the scale of all views' depth against their translations must as well: losses
    that align depth by a free factor do not see it drift, but every view would unproject to another place. The factor
    is the exponential of the mean log-ratio, weighted by the backbone's confidence.

    Args:
        initial: the backbone's geometry.
        depth: ``[B, V, H, W]`` enhanced depth of the same pixels.
    """
    reference = initial.depth.detach()
    valid = (reference > 0) & (depth > 0)
    weight = torch.where(valid, initial.depth_conf.detach(), 0.0)  # [B, V, H, W]
    ratio = torch.where(valid, reference, 1.0).log() - torch.where(valid, depth, 1.0).log()
    mean = (weight * ratio).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=torch.finfo(weight.dtype).tiny)  # [B]
    return depth * mean.exp()[:, None, None, None]


def _to_scene_frame(geometry: Geometry, unit: Tensor) -> Geometry:
    """Scales geometry to scene units and moves the world into context view 0, which becomes exactly the identity."""
    cameras = scale_translations(relative_to_first(geometry.cameras), unit)
    return replace(
        geometry, depth=geometry.depth * unit[:, None, None, None], cameras=cameras, scale=geometry.scale / unit
    )
