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
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from backends.base import Backend
from backends.cache import TokenCache
from vg2gt.geometry.alignment import fit_depth_scale
from vg2gt.geometry.cameras import focal_lengths, relative_to_first, scale_translations
from vg2gt.memory import note_sizes
from vg2gt.method.fine import FineModule
from vg2gt.method.pooled import PooledVoxels
from vg2gt.profiling import stage
from vg2gt.types import Cameras, Decoded, Gaussians, Geometry, Hints, Prediction, Tokens, Voxels, check_choice
from vg2gt.visibility import Support, ViewCheck, keep_agreed

Background = Literal["mean", "black"]
ScaleSource = Literal["metric", "focal", "normalize", "groundtruth"]
_BACKBONE_PREFIX = "backend."
_SEEN_WEIGHT = 0.01  # weight of pixels with depth in the background colour; pixels without depth have weight 1
CANONICAL_FOCAL = 300.0  # appendix A.1: d_metric = f * d_net / 300


@dataclass(frozen=True)
class SceneScale:
    """Fixes the scene unit before voxelisation, with one factor per scene (paper, appendix A.1).

    Args:
        source: ``metric`` (metres, as the backend predicts them), ``focal`` (mean focal length / 300, as the paper does
            with DA3), ``normalize`` (the median depth of the scene becomes ``median_depth``) or ``groundtruth``
            (training only: weighted-median alignment to the depth in the hints).
        median_depth: the median depth after ``normalize``, in scene units.

    Raises:
        ValueError: if the source is unknown.
    """

    source: ScaleSource = "normalize"
    median_depth: float = 1.0

    def __post_init__(self) -> None:
        check_choice("model.scale.source", self.source, ScaleSource)

    def __call__(self, geometry: Geometry, hints: Hints | None) -> Tensor:
        """Returns scene units per unit of ``geometry``: ``[B]``, detached."""
        if self.source == "metric":
            return geometry.scale.detach()
        if self.source == "focal":
            focal = focal_lengths(geometry.cameras.intrinsics)
            return focal.mean((1, 2)).detach() / CANONICAL_FOCAL
        if self.source == "groundtruth":
            if hints is None or hints.depth is None:
                raise ValueError(
                    "model.scale.source=groundtruth requires ground-truth depth; without it, use "
                    "model.scale.source=normalize"
                )
            return fit_depth_scale(geometry.depth, hints.depth, hints.depth > 0).nan_to_num(1.0)
        return torch.stack([self._normalize(depth) for depth in geometry.depth.detach()])

    def _normalize(self, depth: Tensor) -> Tensor:
        valid = depth[depth > 0]
        return self.median_depth / valid.median() if valid.numel() else depth.new_ones(())


class Reconstructor(nn.Module, ABC):
    """Base class of models that reconstruct a Gaussian scene from images on a frozen backbone.

    Training, evaluation and commands use only this interface.

    Args:
        backend: the frozen visual foundation model.
        scale: fixes the scene unit.
        background: colour of rays that hit no Gaussian: ``mean`` (of the pixels without depth, or of all pixels if all
            have depth) or ``black``.
        visibility: selects the pixels whose depth the other views support (not in the paper); None uses all.

    Raises:
        ValueError: if the scale is metric but the backend is not, or the background is unknown.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        super().__init__()
        check_choice("model.background", background, Background)
        if scale.source == "metric" and not backend.is_metric:
            raise ValueError(
                f"model.scale.source=metric requires a metric backend, but {backend.name} is not metric: "
                "use model.scale.source=normalize or focal"
            )
        if visibility is not None and not callable(visibility):  # options alone, such as +model.visibility.moment=3
            raise ValueError("model.visibility has options but no check: this model has none, use model=tiny_ungated")
        backend.freeze()  # again: a subclass may have added layers after its parent's constructor froze the backend
        self.backend = backend
        self.scale = scale
        self.background: Background = background
        self.visibility = visibility
        self.token_cache: TokenCache | None = None  # set by callers that see the same views repeatedly

    @abstractmethod
    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """Reconstructs B scenes.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1]; H and W multiples of the backend's patch size.
            hints: data about the views, for backends that need it.
            generator: random generator for training.

        Returns:
            Geometry and Gaussians, in scene units and the frame of view 0.
        """

    def read_views(
        self, images: Tensor, hints: Hints | None, unit: Tensor | None = None
    ) -> tuple[Tokens, Geometry, Tensor]:
        """Runs the frozen backbone (paper, eqn preliminary_vggt).

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: data about the views.
            unit: ``[B]`` scene units per unit of the backbone; None: from ``self.scale``.

        Returns:
            The tokens, the geometry in scene units and the frame of view 0, and the unit ``[B]``.
        """
        scenes, views, _, height, width = images.shape
        note_sizes({f"images of {height}x{width} in {scenes} scene{'s' * (scenes > 1)}": scenes * views}, first=True)
        tokens, raw = self.run_backbone(images, hints)
        raw = masked(raw, hints)
        unit = self.scale(raw, hints) if unit is None else unit
        return tokens, _to_scene_frame(raw, unit), unit

    def run_backbone(self, images: Tensor, hints: Hints | None) -> tuple[Tokens, Geometry]:
        """Returns the backbone's tokens and decoded geometry, from the cache if there is one.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: data about the views.
        """
        if self.token_cache is not None and self.backend.frozen:
            with stage("encode"):
                return self.token_cache.read(self.backend, images, hints)
        with stage("encode"):
            tokens = self.backend.encode(images, hints)
        with stage("decode"), torch.no_grad():
            return tokens, self.backend.decode(tokens)

    def predict_cameras(self, images: Tensor, hints: Hints | None) -> Cameras:
        """Returns only the backbone's raw cameras, from the cache if there is one.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1].
            hints: data about the views.
        """
        with stage("cameras"):
            if self.token_cache is not None and self.backend.frozen:
                return self.token_cache.cameras(self.backend, images, hints)
            return self.backend.predict_cameras(images, hints)

    def support(self, geometry: Geometry, hints: Hints | None) -> Support | None:
        """Checks each view's depth against the other views; None without a visibility check."""
        if self.visibility is None:
            return None
        with stage("visibility"):
            return self.visibility(geometry, None if hints is None else hints.frame_ids)

    def with_background(self, gaussians: Gaussians, sums: tuple[Tensor, Tensor]) -> Gaussians:
        """Sets the background to the mean colour of pixels without depth (the sky), else of all, unless it is black.

        Args:
            gaussians: Gaussians of B scenes.
            sums: result of :func:`background_sums`, or sums of several.
        """
        if self.background == "black":
            return gaussians
        total, weight = sums
        return replace(gaussians, background=(total / weight).to(gaussians.means.device))

    def trained_parameters(self) -> list[nn.Parameter]:
        """Returns the trainable parameters: all but those of a frozen backbone."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def trained_state(self) -> dict[str, Tensor]:
        """Returns the state that a checkpoint stores: everything but a frozen backbone."""
        return {name: value for name, value in self.state_dict().items() if self._stored(name)}

    def _stored(self, name: str) -> bool:
        return not (self.backend.frozen and name.startswith(_BACKBONE_PREFIX))

    def load_trained(self, state: Mapping[str, Tensor], backend: Mapping[str, Any] | None) -> None:
        """Loads the trained part, which must be complete and does not contain a frozen backbone.

        Args:
            state: result of :meth:`trained_state`.
            backend: identity of the backbone it was trained on.

        Raises:
            ValueError: if it was trained on or with another backbone, or does not fit; nothing is loaded then.
        """
        self.check_backend(backend)
        if self.backend.frozen and any(name.startswith(_BACKBONE_PREFIX) for name in state):
            raise ValueError("the checkpoint holds a trained backbone: use the same backend= with backend.freeze=false")
        present = {name: value.shape for name, value in self.trained_state().items()}
        stored = {name: value.shape for name, value in state.items() if self._stored(name)}
        if stored != present:
            wrong = sorted(name for name in stored.keys() | present.keys() if stored.get(name) != present.get(name))
            raise ValueError(
                f"the checkpoint does not match this model; first mismatch: model.{wrong[0]} (checkpoint "
                f"{stored.get(wrong[0])}, model {present.get(wrong[0])}). Use the model options it was trained with, "
                "or init_from= to load only the matching weights"
            )
        self.load_state_dict(state, strict=False)

    def check_backend(self, stored: Mapping[str, Any] | None) -> None:
        """Checks that weights were trained on this model's backbone.

        Raises:
            ValueError: if they were trained on another one; names both.
        """
        present = dict(self.backend.identity())
        if stored != present:
            raise ValueError(
                f"the checkpoint was trained on backbone {stored}, this run uses {present}: choose the same backend= "
                "and the same weights, or start a new run from it with init_from="
            )


class VG2GT(Reconstructor):
    """Feed-forward Gaussian reconstruction on a frozen backbone (paper, eqn propose).

    See :class:`Reconstructor` for the other arguments; the visibility of the enhanced geometry is checked.

    Args:
        coarse: factory of the coarse-level feature enhancement, called with ``token_dims`` and ``patch_size``; None
            (ablation w/o Coarse) uses the backbone's geometry.
        fine: factory of the fine-level voxel module, called with ``token_dims`` and ``patch_size``.
        gaussians: factory of the self-splitting Gaussian head, called with ``in_channels``.
        keep_scale: rescales the enhanced depth to the scale of the backbone's, see :func:`with_scale_of`.
        keep_agreed: keeps the backbone's depth where other views confirm it
            (:func:`vg2gt.visibility.keep_agreed`), except in training; needs ``visibility``.

    Raises:
        ValueError: if ``keep_agreed`` is set without ``visibility``.
    """

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        coarse: Callable[..., nn.Module] | None,
        fine: Callable[..., FineModule],
        gaussians: Callable[..., nn.Module],
        keep_scale: bool = True,
        background: Background = "black",
        visibility: ViewCheck | None = None,
        keep_agreed: bool = False,
    ) -> None:
        super().__init__(backend, scale, background, visibility)
        if keep_agreed and visibility is None:
            raise ValueError("model.keep_agreed=true requires model.visibility, which compares the views")
        self.keep_agreed = keep_agreed
        dims, patch = backend.token_dims, backend.patch_size
        self.keep_scale = keep_scale
        self.coarse = coarse(token_dims=dims, patch_size=patch) if coarse else None
        self.fine = fine(token_dims=dims, patch_size=patch)
        self.gaussians = gaussians(in_channels=self.fine.out_channels)

    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """See :meth:`Reconstructor.forward`; ``generator`` draws serialisation orders of the coarse module."""
        # coarse level: images [B, V, 3, H, W] to enhanced tokens [B, V, P, D] and depth [B, V, H, W]
        tokens, decoded = self.enhance(images, hints, generator)
        # ours: mask of pixels that other views do not contradict [B, V, H, W]
        support = self.support(decoded.geometry, hints)
        keep, coarsen = (None, None) if support is None else (support.keep, support.coarsen)
        # fine level: pixels to M voxels
        geometry = decoded.geometry.where(keep)
        with stage("fine"):
            size = self.fine.voxel_edges(geometry, coarsen)
            pooled = self.fine.pool(tokens, geometry, images, size)
        voxels, gaussians = self.finish(pooled, size, background_sums(images, decoded.initial.depth))
        return Prediction(decoded.initial, decoded.geometry, decoded.unit, voxels, gaussians, keep)

    def finish(self, pooled: PooledVoxels, size: Tensor, background: tuple[Tensor, Tensor]) -> tuple[Voxels, Gaussians]:
        """Turns the pooled voxels of B whole scenes into Gaussians; those of a long capture are merged before.

        Args:
            pooled: M voxels (:meth:`vg2gt.method.fine.FineModule.pool`).
            size: ``[B]`` their edges in scene units.
            background: :func:`background_sums` of all views.
        """
        # voxels with features [M, C]
        with stage("fine"):
            voxels = self.fine.refine(pooled, size)
        # every voxel splits into K Gaussians: [M * K]
        with stage("gaussians"):
            return voxels, self.with_background(self.gaussians(voxels), background)

    def enhance(
        self,
        images: Tensor,
        hints: Hints | None = None,
        generator: torch.Generator | None = None,
        unit: Tensor | None = None,
    ) -> tuple[Tokens, Decoded]:
        """Runs the method up to the enhanced geometry (paper, Coarse-level).

        Args:
            images: as for :meth:`forward`.
            hints: as for :meth:`forward`.
            generator: as for :meth:`forward`.
            unit: ``[B]`` scene units per unit of the backbone; None: from ``self.scale``.

        Returns:
            The enhanced tokens, and the geometry before and after enhancement.
        """
        # frozen backbone: tokens [B, V, P, D], depth and cameras
        tokens, initial, unit = self.read_views(images, hints, unit)
        if self.coarse is None:
            return tokens, Decoded(initial, initial, unit)
        # points to coarse voxels, PTv3, back to tokens; the same frozen heads decode them again
        with stage("coarse"):
            tokens = self.coarse(tokens, initial, generator=generator)
        with stage("decode_again"):
            again = masked(self.backend.decode_again(tokens, initial.cameras), hints)
        # the camera token is unchanged, so the cameras of the first decoding stay valid
        depth = again.depth * unit[:, None, None, None]
        depth = depth if not self.keep_scale else with_scale_of(initial, depth)
        if self.keep_agreed and self.visibility is not None and not self.training:
            depth = keep_agreed(initial, depth, self.visibility)
        return tokens, Decoded(initial, replace(initial, depth=depth, depth_conf=again.depth_conf), unit)


def background_sums(images: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the weighted colour sum ``[B, 3]`` and the weight sum ``[B, 1]``; their ratio is the background."""
    weight = torch.where(depth > 0, _SEEN_WEIGHT, 1.0)[:, :, None]  # [B, V, 1, H, W]
    return (weight * images.detach().float()).sum((1, 3, 4)), weight.sum((1, 3, 4))


def masked(geometry: Geometry, hints: Hints | None) -> Geometry:
    """Removes depth where the mask is at most 0.5, and multiplies the confidence by the mask."""
    if hints is None or hints.mask is None:
        return geometry
    kept = geometry.where(hints.mask > 0.5)
    return replace(kept, depth_conf=geometry.depth_conf * hints.mask.clamp(min=1e-3))


def with_scale_of(initial: Geometry, depth: Tensor) -> Tensor:
    """Rescales the enhanced depth to the scale of the initial depth, with one differentiable factor per scene.

    The cameras stay the backbone's, so the depth must keep its scale relative to their translations. Losses that align
    depth by a free factor do not notice a drift, but every view would unproject to a different place. The factor is the
    exponential of the mean log-ratio, weighted by the backbone's confidence.

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
    """Scales geometry to scene units and makes view 0 the world frame, with exactly the identity as its pose."""
    cameras = scale_translations(relative_to_first(geometry.cameras), unit)
    return replace(
        geometry, depth=geometry.depth * unit[:, None, None, None], cameras=cameras, scale=geometry.scale / unit
    )
