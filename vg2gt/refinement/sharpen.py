"""Second stage of a refinement: the photographs at their own size, crop by crop, with Gaussians that split."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.losses.gaussian import where_it_counts
from vg2gt.metrics import psnr
from vg2gt.refinement.exposure import log_exposures
from vg2gt.refinement.growth import footprints, in_front, note_seen, remove_idle, split_large
from vg2gt.refinement.options import FullSizeOptions, Observations, Observer, Progress, RefineLoss, RefineOptions
from vg2gt.refinement.parameters import Parameters, RefinedScene
from vg2gt.refinement.photographs import Crop, CropOrder, Photographs, whole_views
from vg2gt.rendering import Renderer

log = logging.getLogger(__name__)

FINAL_RATE = 0.1  # factor to which rates decay exponentially
FEWEST = 6  # with fewer views, none is left out
_SCORED = 3  # maximum number of left-out views
APART = 20  # minimum number of steps between two checks
CHECKS = 8  # number of times that left-out views are scored
SMOOTH = 3  # number of checks to average: a single view varies by half a dB from check to check
_NOTICED = 0.7  # dB below the best average at which the stage becomes shorter; at 0.1, a set lost 0.3 dB by chance
_REJECTED = 1.5  # dB below the start at which the stage is given up; at 0.1, a set lost 2.5 dB by chance
# size of the photographs, in working sizes, from which the stage begins at half of it and compensates opacities
LARGE = 2.5


@dataclass(frozen=True)
class Sharpened:
    """Result of the second stage.

    Attributes:
        scene: the scene; its cameras have the photographs' size.
        steps: number of steps.
        ended: ``steps``, ``seconds``, ``interrupted``, ``diverged``, ``overfitting`` (left-out views became worse, and
            the stage ended early) or ``no gain`` (it made them worse from the start, and ``scene`` is the start).
        fold: left-out views.
        scores: PSNR of the left-out views in dB, before and while they were left out, over pixels that are not masked.
        growth: number of Gaussians that were split.
        renderer: renderer that the scene was fitted with; scenes of large photographs are ``antialiased``.
    """

    scene: RefinedScene
    steps: int
    ended: str
    fold: tuple[int, ...]
    scores: tuple[float, ...]
    growth: int
    renderer: Renderer

    @property
    def score(self) -> float | None:
        """PSNR of the left-out views in ``scene`` or, if they were trained at the end, before; None: none left out."""
        if not self.scores:
            return None
        return self.scores[0 if self.ended == "no gain" else -1]


def sharpen(
    start: RefinedScene,
    photographs: Photographs,
    seen: Observations,
    renderer: Renderer,
    options: RefineOptions,
    seconds: float | None = None,
    trained: Tensor | None = None,
    observe: Observer | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Sharpened:
    """Optimises a refined scene on crops of its photographs.

    Ctrl-C ends it and returns the state reached.

    Args:
        start: the scene, with cameras at the working size.
        photographs: photographs of its V views.
        seen: observations of the views at the working size, for the terms of depth and normals.
        renderer: renderer of the scene.
        options: options; ``options.full`` must not be None.
        seconds: maximum time, > 0; None: until ``options.full.steps`` are made.
        trained: ``[N]`` views to train on; None: all that are not masked as a whole.
        observe: called after every step.
        clock: returns the time in seconds.
    """
    if trained is None:
        trained = seen.shown().nonzero()[:, 0]
    with torch.enable_grad():
        return _Sharpening(start, photographs, seen, renderer, options, seconds, trained, clock).run(observe)


class _Sharpening:
    def __init__(
        self,
        start: RefinedScene,
        photographs: Photographs,
        seen: Observations,
        renderer: Renderer,
        options: RefineOptions,
        seconds: float | None,
        trained: Tensor,
        clock: Callable[[], float],
    ) -> None:
        assert options.full is not None
        self.options, self.full = options, options.full
        self.loss = replace(options.loss, ssim=options.full.ssim * options.loss.ssim)
        large = max(photographs.size) >= LARGE * max(start.cameras.size)
        self.whole, self.seen = photographs, seen
        self.photographs = photographs.halved() if large and self.full.coarse else photographs
        # rendered smaller than it was fitted, a scene of small Gaussians is right only with compensated opacities;
        # what was fitted at the working size is too small for them there, but not at much larger sizes
        self.given, self.renderer = renderer, replace(renderer, antialiased=True) if large else renderer
        self.poses = start.cameras
        start = (
            replace(start, cameras=self.photographs.cameras(start.cameras)).with_degree(self.full.sh_degree).detach()
        )
        self.clock, self.began, self.seconds = clock, clock(), seconds
        self.views = trained
        self.fold = fold_of(trained, self.full)
        visible = seen.depth[seen.depth > 0]
        self.depth = float(visible.median()) if len(visible) else 1.0
        focal = float(photographs.intrinsics[:, [0, 1], [0, 1]].mean())
        rates = options.rates
        rates = replace(rates, means=self.full.rate * rates.means, sh=self.full.rate * rates.sh)
        self.early = trained[~torch.isin(trained, self.fold)]
        self.parameters = Parameters(start, rates, 1 / focal, self.depth, self.early)
        note_seen(self.parameters, self.early, self.renderer)
        self.limit = _most_steps(self.full, photographs, len(trained), seconds)
        self.open = not len(self.fold)
        self.order = self._order()
        self.stretch = 1.0  # of the stage that is left to run
        self.steps = self.growth = self.checked = 0
        self.recent: list[float] = []
        self.scores: list[float] = []

    def run(self, observe: Observer | None) -> Sharpened:
        """Runs steps, growth and checks until the stage ends."""
        ended = ""
        try:
            self._grow(twice=True)
            if not self.open:
                self.scores.append(self._score())
            while not ended:
                ended = self._step()
                if observe is not None:
                    recent = sum(self.recent) / max(1, len(self.recent))
                    observe(Progress(self.steps, self._done(), recent, self.parameters.present))
        except KeyboardInterrupt:
            ended = "interrupted"
        useless = ended == "no gain"
        scene = self.parameters.start if useless else self.parameters.present()
        scene = replace(scene, cameras=self.whole.cameras(scene.cameras))
        return Sharpened(
            scene=scene,
            steps=self.steps,
            ended=ended,
            fold=tuple(self.fold.tolist()),
            scores=tuple(self.scores),
            growth=self.growth,
            renderer=self.given if useless else self.renderer,
        )

    def _raw(self) -> float:
        """Share of the planned steps or seconds that has passed."""
        spent = 0.0 if self.seconds is None else (self.clock() - self.began) / self.seconds
        return max(self.steps / self.limit, spent)

    def _done(self) -> float:
        return min(1.0, self._raw() / self.stretch)

    def _order(self) -> CropOrder:
        views = self.views if self.open else self.early
        return CropOrder(self.photographs, self.full.crop, views, self.options.seed)

    def _step(self) -> str:
        """Runs one step and what is due after it; returns how the stage ended, or an empty string."""
        every = self.full.geometry_every
        of_step = self.loss.with_geometry(0 if self.steps % every else every)
        crop = self.order.deal()
        rows = self._rows(crop)
        scene = self.parameters.scene(rows)
        rendered, image = self._terms(scene, crop, of_step)
        if terms := of_step.of_gaussians(scene.gaussians, self.parameters.seen[rows]):
            rendered = rendered + of_step.total(terms)
        self.recent = [*self.recent, *([image] if math.isfinite(image) else [])][-20:]
        self.steps += 1
        if not self.parameters.step(rendered, FINAL_RATE ** self._done()):
            log.warning("refinement at full size, step %d: the loss or its gradient is not finite", self.steps)
            return "diverged"
        done = self._done()
        if done >= 1:
            return "overfitting" if self.stretch < 1 else "steps" if self.steps >= self.limit else "seconds"
        if self.photographs is not self.whole and done >= self.full.coarse:
            self._enlarge()
        if self.steps % self.full.grow_every == 0:
            self.parameters.prune()
            if done < self.full.grow_until:
                self._grow()
        return "" if self.open else self._watch(done)

    def _rows(self, crop: Crop) -> Tensor:
        """Returns the Gaussians that a crop may show."""
        values, camera = self.parameters.values, crop.camera(self.parameters.cameras)
        return in_front(values["scales"], values["means"], camera, self.renderer.near)

    def _terms(self, scene: RefinedScene, crop: Crop, loss: RefineLoss) -> tuple[Tensor, float]:
        """Returns the loss of one crop, and its PSNR in dB; NaN if it is masked as a whole."""
        camera = crop.camera(scene.cameras)
        seen = crop.observations(self.photographs, self.seen, self.poses.intrinsics[0])
        view = torch.tensor([crop.view], device=seen.images.device)
        rendered = replace(self.renderer, geometry=loss.needs_geometry)(scene.gaussians, camera)
        color = scene.exposed(rendered.color, view)
        counted = where_it_counts(color[0], seen.images, seen.mask)
        terms = loss.of_views(replace(rendered, color=counted[None]), camera, seen, self.depth)
        return loss.total(terms), float(psnr(color[0].detach(), seen.images, seen.mask))

    def _enlarge(self) -> None:
        """Goes on from half to full size."""
        self.photographs, start = self.whole, self.parameters.start
        self.parameters.start = replace(start, cameras=self.whole.cameras(start.cameras))
        self.order = self._order()

    def _open(self) -> None:
        """Trains all views from now on; the exposures of those left out so far start as the scene suggests."""
        self.open = True
        self.order = self._order()
        note_seen(self.parameters, self.views, self.renderer)
        if self.parameters.rates["gain"]:
            scene, fold = self.parameters.scene().detach(), self.fold.to(self.seen.images.device)
            cameras = replace(self.poses, world_to_camera=scene.cameras.world_to_camera).select(fold)
            found = log_exposures(scene.gaussians, cameras, self.seen.views(fold), self.renderer)
            self.parameters.values["gain"][fold] = found

    def _grow(self, twice: bool = False) -> None:
        views = self.views.to(self.seen.images.device)
        cameras = self.whole.cameras(self.parameters.cameras).select(views)
        remove_idle(self.parameters, cameras, self.renderer, self.full.least)
        for factor in (1.5, 1.5) if twice else (1.0,):
            pixels = factor * self.full.footprint
            self.growth += split_large(self.parameters, cameras, self.renderer.near, pixels, self.full.max_gaussians)
        seen = footprints(self.parameters.values["means"], cameras, self.renderer.near)
        self.parameters.least = torch.where(seen > 0, (self.full.thinnest / seen).log(), -math.inf)

    @torch.no_grad()
    def _score(self) -> float:
        """Returns the mean PSNR of the left-out views at full size in dB."""
        scene = self.parameters.scene()
        scene = replace(scene, cameras=self.whole.cameras(scene.cameras))
        plain, total = replace(self.renderer, geometry=False), 0.0
        for crop in whole_views(self.whole, self.fold):
            color = plain(scene.gaussians, crop.camera(scene.cameras)).color[0]
            seen = crop.observations(self.whole, self.seen, self.poses.intrinsics[0])
            if self.parameters.rates["gain"]:
                color = matched(color, seen.images, seen.mask)  # nothing else knows the exposure of a left-out view
            total += float(psnr(color, seen.images, seen.mask))
        return total / len(self.fold)

    def _watch(self, done: float) -> str:
        """Scores the left-out views if it is time; trains all views once these are worse, or late in the stage."""
        due = len(self.scores) * self.full.opened / CHECKS
        if done >= due and self.steps >= self.checked + APART:
            self.scores.append(self._score())
            self.checked = self.steps
        smooth = [sum(self.scores[:n][-SMOOTH:]) / min(n, SMOOTH) for n in range(1, len(self.scores) + 1)]
        fall = max(smooth) - smooth[-1] if len(smooth) > SMOOTH else 0.0
        worse = fall > _NOTICED
        if fall > _REJECTED and smooth[0] == max(smooth):
            return "no gain"
        if worse:
            self.stretch = self._raw() / self.full.opened
        if worse or done >= self.full.opened:
            self._open()
        return ""


def matched(color: Tensor, images: Tensor, mask: Tensor | None = None) -> Tensor:
    """Returns colours ``[R, 3, H, W]`` with the gain and bias of each channel that fit the images best.

    Args:
        color: rendered colours.
        images: images of the same views.
        mask: ``[R, H, W]`` weights of the pixels; None: all 1.
    """
    weights = torch.ones_like(color[:, :1]) if mask is None else mask[:, None]

    def mean(values: Tensor) -> Tensor:
        return (weights * values).sum((2, 3), keepdim=True) / weights.sum((2, 3), keepdim=True)

    centred, middle = color - mean(color), mean(images)
    gain = mean(centred * (images - middle)) / mean(centred.square())
    return gain.nan_to_num(1.0) * centred + middle


def fold_of(views: Tensor, options: FullSizeOptions) -> Tensor:
    """Returns the views of ``views [N]`` that are left out at first: one of several, but no more than three."""
    if not options.fold or len(views) < FEWEST:
        return views[:0]
    count = min(_SCORED, max(1, len(views) // options.fold))
    places = (torch.arange(count, dtype=torch.float64) + 0.5) * len(views) / count
    return views[places.long()]


def _most_steps(options: FullSizeOptions, photographs: Photographs, views: int, seconds: float | None) -> int:
    """Returns the number of steps: what each pixel's renderings allow and, without ``seconds``, the options' own."""
    height, width = photographs.size
    share = min(1.0, options.crop / height) * min(1.0, options.crop / width)
    most = max(1, math.ceil(options.renderings * views / share))
    return most if seconds is not None else min(options.steps, most)
