"""Reconstruction of a long capture: each window goes through the model, then the voxels of all windows are merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from vg2gt.geometry.cameras import scale_translations, strided_intrinsics
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.inputs.pictures import Picture
from vg2gt.method.pooled import PooledVoxels
from vg2gt.model import VG2GT, Reconstructor, background_sums
from vg2gt.monitor import Monitor
from vg2gt.reconstruction.order import thumbnails, working_order
from vg2gt.reconstruction.windows.placement import (
    Found,
    closes,
    loop_candidates,
    moves_onto,
    place_found,
    place_windows,
    seen_from,
)
from vg2gt.reconstruction.windows.store import Capture, Window, WindowStore, cut, merge_windows, remove, set_key
from vg2gt.types import Cameras, Gaussians, Geometry, Tokens
from vg2gt.uncertainty import Calibration
from vg2gt.visibility import Status, pixel_evidence
from vg2gt.visibility.check import choose_partners

TOKEN_BYTES = 4e9  # maximum size of all windows' tokens on disk; if larger, the backbone runs a second time instead
_REDUCED = 4  # pixel stride of the depth that places windows
_MEDIAN_OF = 1 << 24  # maximum number of depths in a median


def window_model(model: Reconstructor) -> VG2GT:
    """Returns the model if it supports windows.

    Raises:
        ValueError: if it does not; the message names the remedy.
    """
    if model.visibility is not None and model.visibility.moment is not None:
        raise ValueError("motion detection needs all views at once: add --window 0 or model.visibility.moment=null")
    if isinstance(model, VG2GT):
        return model
    raise ValueError(f"{type(model).__name__} reconstructs all views at once: add --window 0, or take fewer views")


def device_of(model: Reconstructor) -> torch.device:
    """Returns the device of a model's parameters; the CPU if it has none."""
    return next((parameter.device for parameter in model.parameters()), torch.device("cpu"))


class WindowRun:
    """One reconstruction in windows.

    Args:
        model: in eval mode.
        pictures: pictures of the views, in order.
        size: ``(height, width)`` of the images.
        window: maximum number of own views per window.
        folder: folder for finished steps, from which an interrupted run resumes.
        monitor: shows the progress.
    """

    def __init__(
        self,
        model: VG2GT,
        pictures: Sequence[Picture],
        size: tuple[int, int],
        window: int,
        folder: Path,
        monitor: Monitor,
    ) -> None:
        self.model, self.monitor, self.count, self.device = model, monitor, len(pictures), device_of(model)
        self.store = WindowStore(folder, set_key(model, pictures, size, window))
        self.capture = Capture(self.store, pictures, size, monitor)
        self.windows = cut(len(pictures), window)
        self.blocks = [each.own for each in self.windows]
        shape = (self.count, *size)
        self.raw, self.conf = (self.store.array(name, shape) for name in ("raw_depth", "depth_conf"))
        self.depth = self.store.array("depth", shape)
        self.units = torch.ones(self.count)  # of the scene in those of each view's window

    def geometry_and_gaussians(self) -> tuple[Geometry, Gaussians, Tensor]:
        """Returns the geometry of all views, with depth only where the scene uses it, the Gaussians, and the unit."""
        surveyed = self.survey()
        cameras, scales = self._placement(surveyed)
        # windows' units to the cameras' unit: [V, H, W]
        metres = torch.cat([each["scale"] for each in surveyed]) / scales[[rows.start for rows in self.blocks]]
        for rows in self.blocks:
            self.depth[rows] = self.raw[rows] * scales[rows, None, None]
        reference = cameras.world_to_camera[0, working_order(self.capture.images)[0]]
        # the cameras' frame and unit to the scene's
        geometry = Geometry(self.depth[None], self.conf[None], seen_from(reference, cameras), metres.median()[None])
        unit = self.model.scale(_sampled(geometry), None)
        for rows in self.blocks:
            self.depth[rows] *= unit
        self.units = scales * unit.cpu()
        geometry = replace(geometry, cameras=scale_translations(geometry.cameras, unit), scale=geometry.scale / unit)
        # visibility check, fine voxels of each window, Gaussians of all windows
        size = self._check(geometry)
        gaussians = self._finish(self._pool(geometry, size), size)
        remove(self.store.folder.parent, but=self.store.folder)
        return replace(geometry, cameras=geometry.cameras.to(self.device)), gaussians, unit

    def trust(self, geometry: Geometry, calibration: Calibration | None) -> tuple[Tensor | None, Tensor]:
        """Returns stated error and status of all pixels, each compared with the other views of its window.

        Args:
            geometry: that of :meth:`geometry_and_gaussians`, which comes first.
            calibration: calibration of the model; None: no errors are stated.

        Returns:
            ``[V, H, W]`` each, as of :func:`vg2gt.reconstruction.trust.pixel_trust`; the error is memory-mapped.
        """
        status = torch.zeros(self.raw.shape, dtype=torch.uint8)
        error = None if calibration is None else self.store.array("error", self.raw.shape)
        kept = self.store.array("kept") if self.model.visibility is not None else None
        with self.monitor.stage("errors", len(self.windows)) as advance:
            for window in self.windows:
                views, own, mask = window.views, window.own, self.capture.mask
                decoded = replace(
                    geometry,
                    depth=(self.raw[views] * self.units[views, None, None])[None].to(self.device),
                    depth_conf=self.conf[None, views].to(self.device),
                    cameras=geometry.cameras.select(views.to(self.device)),
                )
                keep = None if kept is None else (kept[None, views] > 0).to(self.device)
                evidence, found = pixel_evidence(decoded, keep)
                evidence, found = evidence[window.inner], found[window.inner]
                if calibration is not None and error is not None:
                    error[own] = calibration.error(evidence, found).cpu()
                status[own] = found.cpu()
                if mask is not None:
                    status[own][mask[own] <= 0.5] = Status.UNSEEN
                advance()
        return error, status

    def survey(self) -> list[dict[str, Tensor]]:
        """Computes the depth of all views in their windows' units; returns what is needed to place each window."""
        with self.monitor.stage("windows", len(self.windows)) as advance:
            found = []
            for number, window in enumerate(self.windows):
                name = f"window-{number:06d}"
                known = self.store.load(name)
                if known is None:
                    tokens, geometry = self._enhanced(window.views)
                    depth = geometry.depth[0, window.inner].nan_to_num(0.0, 0.0, 0.0)
                    self.raw[window.own] = depth.cpu()
                    self.conf[window.own] = geometry.depth_conf[0, window.inner].cpu()
                    self._keep_tokens(number, window, tokens)
                    known = _summary(window.views, tokens, geometry)
                    self.store.save(name, known)
                found.append(known)
                advance()
        return found

    def loops(self, surveyed: Sequence[dict[str, Tensor]]) -> list[Found]:
        """Returns predictions for similar views taken at different times, if they see the same surfaces."""
        rows = [each["descriptors"][w.inner] for each, w in zip(surveyed, self.windows, strict=True)]
        each = len(self.windows) // 4 + 1  # tokens capture content; thumbnails do not depend on a window's frame
        alike = (thumbnails(self.capture.images), torch.cat(rows))
        pairs = list(dict.fromkeys(p for described in alike for p in loop_candidates(described, self.blocks, each)))
        half, found = len(self.windows[0].views) // 2, []
        with self.monitor.stage("close loops", len(pairs)) as advance:
            for number, pair in enumerate(pairs):
                firsts = [min(max(view - half // 2, 0), self.count - half) for view in pair]
                views = torch.cat([torch.arange(first, first + half) for first in firsts])
                known = self.store.load(f"loop-{number:06d}")
                if known is None:
                    known = _summary(views, *self._enhanced(views))
                    self.store.save(f"loop-{number:06d}", known)
                loop = found_of(known)
                if closes(loop, (torch.arange(half), torch.arange(half, 2 * half))):
                    found.append(loop)
                advance()
        return found

    def _enhanced(self, views: Tensor) -> tuple[Tokens, Geometry]:
        """Returns tokens and geometry of some views in the unit of the backbone."""
        images, hints = self.capture.views(views)
        images, hints = images.to(self.device), hints.to(self.device)
        # Without enhancement nothing depends on the unit, and a unit of 1 keeps depth exact.
        one = None if self.model.coarse is not None else torch.ones(1, device=self.device)
        with half_precision_on_gpu(images):
            tokens, decoded = self.model.enhance(images, hints, unit=one)
        geometry, unit = decoded.geometry, decoded.unit
        if one is None:
            geometry = replace(
                geometry,
                depth=geometry.depth / unit,
                cameras=scale_translations(geometry.cameras, 1 / unit),
                scale=geometry.scale * unit,
            )
        return tokens, geometry

    def _keep_tokens(self, number: int, window: Window, tokens: Tokens) -> None:
        own = {f"{tap:03d}": patch[:, window.inner].clone() for tap, patch in enumerate(tokens.patch)}
        if sum(patch[:, 0].nbytes for patch in own.values()) * self.count <= TOKEN_BYTES:
            self.store.save(f"tokens-{number:06d}", own)

    def _tokens(self, number: int, window: Window) -> Tokens:
        """Returns the tokens of a window's own views for the fine level."""
        found = self.store.load(f"tokens-{number:06d}")
        if found is None:
            patch = tuple(tap[:, window.inner] for tap in self._enhanced(window.views)[0].patch)
        else:
            patch = tuple(found[name].to(self.device) for name in sorted(found))
        height, width = self.capture.size
        grid = (height // self.model.backend.patch_size, width // self.model.backend.patch_size)
        return Tokens(patch, patch[-1][:, :, 0], grid, self.capture.size)

    def _placement(self, surveyed: list[dict[str, Tensor]]) -> tuple[Cameras, Tensor]:
        given = self.capture.given
        if given is not None and not self.model.backend.predicts_cameras:
            return given, torch.ones(self.count)
        found = [found_of(each) for each in surveyed]
        moves = place_windows(found, self.loops(surveyed)) if given is None else moves_onto(found, given)
        return place_found(found, moves, self.windows, self.capture.size)

    def _check(self, geometry: Geometry) -> Tensor:
        """Removes depth that other views contradict; returns the edge of the fine voxels ``[1]``."""
        check, coarsen = self.model.visibility, None
        if check is not None:
            masks = (self.store.array("kept", self.depth.shape), self.store.array("kept_next", self.depth.shape))
            with self.monitor.stage("views check views", check.rounds * len(self.windows)) as advance:
                partners = choose_partners(self.depth, geometry.cameras, check.partners)
                coarsen = check.coarsening(self.depth, geometry.cameras, partners)[None]
                for _ in check.in_blocks(self.depth, geometry.cameras, partners, self.blocks, masks):
                    advance()
            for rows in self.blocks:
                self.depth[rows] *= masks[0][rows]
        return self.model.fine.voxel_edges(_sampled(geometry), coarsen)

    def _pool(self, geometry: Geometry, size: Tensor) -> PooledVoxels:
        """Returns the fine voxels ``[M]`` of all windows."""
        with self.monitor.stage("fine voxels", len(self.windows)) as advance:
            for number, window in enumerate(self.windows):
                name = f"voxels-{number:06d}"
                if not self.store.has(name):
                    part = Geometry(
                        geometry.depth[:, window.own].to(self.device),
                        geometry.depth_conf[:, window.own].to(self.device),
                        geometry.cameras.select(window.own).to(self.device),
                        geometry.scale.to(self.device),
                    )
                    images = self.capture.images[None, window.own].to(self.device)
                    tokens = self._tokens(number, window)
                    with half_precision_on_gpu(images):
                        pooled = self.model.fine.pool(tokens, part, images, size.to(self.device), capped=False)
                    self.store.save(name, {key: value for key, value in vars(pooled).items() if value is not None})
                advance()
        return merge_windows(self.store.files("voxels"), self.monitor)

    def _finish(self, pooled: PooledVoxels, size: Tensor) -> Gaussians:
        sums = [background_sums(self.capture.images[None, rows], self.raw[None, rows]) for rows in self.blocks]
        total, weight = (torch.stack(parts).sum(0) for parts in zip(*sums, strict=True))
        with self.monitor.stage("Gaussians"), half_precision_on_gpu(torch.empty(0, device=self.device)):
            pooled = self.model.fine.limited(pooled.to(self.device))
            return self.model.finish(pooled, size.to(self.device), (total, weight))[1]


def _summary(views: Tensor, tokens: Tokens, geometry: Geometry) -> dict[str, Tensor]:
    """Returns what places a window: cameras, reduced depth, metres per unit, and a descriptor of each view."""
    shallow, cameras = tokens.patch[0][0].float(), geometry.cameras
    reduced = geometry.depth[0, :, _REDUCED // 2 :: _REDUCED, _REDUCED // 2 :: _REDUCED]
    found = {
        "views": views,
        "poses": cameras.world_to_camera,
        "intrinsics": cameras.intrinsics,
        "depth": reduced.nan_to_num(0.0, 0.0, 0.0),
        "scale": geometry.scale,
        "descriptors": torch.cat((shallow.mean(1), shallow.std(1)), -1),
    }
    return {name: tensor.cpu() for name, tensor in found.items()}


def found_of(known: dict[str, Tensor]) -> Found:
    """Returns a window's cameras and reduced depth from its summary."""
    size = (known["depth"].shape[1], known["depth"].shape[2])
    sampled = strided_intrinsics(known["intrinsics"], _REDUCED, _REDUCED)
    return Found(known["views"], Cameras(known["poses"], sampled, size), known["depth"], known["intrinsics"])


def _sampled(geometry: Geometry) -> Geometry:
    """Subsamples geometry evenly, if it has too many depths for a median."""
    step = 1
    while geometry.depth.numel() // step**2 > _MEDIAN_OF:
        step += 1
    return replace(geometry, depth=geometry.depth[..., step // 2 :: step, step // 2 :: step])
