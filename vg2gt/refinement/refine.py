"""Refinement of one scene on its own images."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.losses.gaussian import where_it_counts
from vg2gt.metrics import psnr
from vg2gt.refinement.density import fill_holes, supported, with_points
from vg2gt.refinement.growth import note_seen
from vg2gt.refinement.options import Observations, Observer, Progress, RefineLoss, RefineOptions
from vg2gt.refinement.parameters import Parameters, RefinedScene
from vg2gt.refinement.photographs import Photographs
from vg2gt.refinement.sharpen import Sharpened, sharpen
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

log = logging.getLogger(__name__)

_WORSE = 2.0  # loss of left-out views, relative to the start and to the best state, that counts as divergence
FINAL_RATE = 0.1  # factor to which rates decay exponentially
_MAX_GROWTH = 1.5  # maximum number of Gaussians after filling holes, as a multiple of the initial number
FEWEST = 4  # with fewer views, none is left out
_LEFT_OUT = 8  # one view in this many is left out at a time
SMOOTH = 3  # number of checks to average, since each scores other views


@dataclass(frozen=True)
class Refined:
    """Result of a refinement.

    Attributes:
        start: the given scene.
        scene: best state, in the frame in which the camera of view 0 has its initial pose.
        step: step at which it was reached.
        steps: number of steps made.
        seconds: elapsed on the refinement's clock.
        ended: ``steps``, ``seconds``, ``interrupted`` or ``diverged``.
        psnr: ``[2, V]`` PSNR of every view before and after, in dB, over the pixels that are not masked.
        trained: ``[N]`` views that were trained on.
        held_out: the other views, without those that are masked as a whole.
        sharpened: result of the stage at full size; None if there was none. Its steps are among ``steps``.
    """

    start: RefinedScene
    scene: RefinedScene
    step: int
    steps: int
    seconds: float
    ended: str
    psnr: Tensor
    trained: Tensor
    held_out: Tensor
    sharpened: Sharpened | None = None


def sharpened(
    refined: Refined,
    photographs: Photographs,
    seen: Observations,
    renderer: Renderer,
    options: RefineOptions,
    seconds: float | None = None,
    observe: Observer | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Refined:
    """Continues a refinement on the photographs at their own size; arguments as for :func:`sharpen`."""
    began = clock()
    trained, held_out = split_views(seen, options.holdout)
    sharp = sharpen(refined.scene, photographs, seen, renderer, options, seconds, trained, observe, clock)
    steps = refined.steps + sharp.steps
    if sharp.ended == "no gain":
        return replace(refined, steps=steps, seconds=refined.seconds + clock() - began, sharpened=sharp)
    poses = replace(refined.scene.cameras, world_to_camera=sharp.scene.cameras.world_to_camera)
    scene = replace(sharp.scene, cameras=poses)
    if options.rates.cameras:
        scene = scene.seen_from(refined.scene.cameras.world_to_camera[0, 0])
    _, after = _view_losses(scene, seen, sharp.renderer, options.loss.with_geometry(0), torch.arange(len(seen.images)))
    return replace(
        refined,
        scene=scene,
        steps=steps,
        step=steps,
        seconds=refined.seconds + clock() - began,
        ended="steps" if sharp.ended == "overfitting" else sharp.ended,
        psnr=torch.stack((refined.psnr[0], after)),
        trained=trained,
        held_out=held_out,
        sharpened=sharp,
    )


@torch.no_grad()
def _view_losses(
    scene: RefinedScene, seen: Observations, renderer: Renderer, loss: RefineLoss, views: Tensor, unit: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Returns loss and PSNR ``[R]`` of views ``[R]``, each rendered on its own, on the CPU."""
    found = [_view_loss(scene, seen, renderer, loss, view, unit) for view in views.to(seen.images.device).split(1)]
    return torch.stack([each for each, _ in found]).cpu(), torch.cat([image for _, image in found]).cpu()


def _view_loss(
    scene: RefinedScene, seen: Observations, renderer: Renderer, loss: RefineLoss, views: Tensor, unit: float
) -> tuple[Tensor, Tensor]:
    """Returns the loss of some views, and their PSNR ``[R]``; ``unit``: median depth of the scene."""
    cameras, seen = scene.cameras.select(views), seen.views(views)
    rendered = replace(renderer, geometry=loss.needs_geometry)(scene.gaussians, cameras)
    color = scene.exposed(rendered.color, views)
    counted = replace(rendered, color=where_it_counts(color[0], seen.images, seen.mask)[None])
    terms = loss.of_views(counted, cameras, seen, unit)
    return loss.total(terms), psnr(color[0].detach(), seen.images, seen.mask)


def refine(
    gaussians: Gaussians,
    cameras: Cameras,
    seen: Observations,
    renderer: Renderer,
    options: RefineOptions | None = None,
    observe: Observer | None = None,
    clock: Callable[[], float] = time.monotonic,
    fold: Tensor | None = None,
    points: tuple[Tensor, Tensor] | None = None,
) -> Refined:
    """Optimises one scene on the images of its views.

    Ctrl-C ends it and returns the best state so far; so does a loss that is not finite or diverges, with a warning.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        seen: observations of the views, on the same device.
        renderer: renderer of the scene, here and later.
        options: options of the refinement; default :class:`RefineOptions`.
        observe: called after every step.
        clock: returns the time in seconds.
        fold: ``[F]`` views that are not trained yet, because a later stage scores them (:func:`fold_of`).
        points: ``[N, 3]`` positions and ``[N, 3]`` colours of points that get a Gaussian where the scene has none.

    Raises:
        ValueError: if there are no Gaussians, or images and cameras do not match.
    """
    options = options or RefineOptions()
    views, height, width = seen.depth.shape
    found = (tuple(cameras.world_to_camera.shape[:2]), tuple(cameras.size), tuple(seen.images.shape))
    if found != ((1, views), (height, width), (views, 3, height, width)) or seen.depth_conf.shape != seen.depth.shape:
        raise ValueError(
            f"refinement needs one scene with matching images, depth and cameras, got cameras {found[0]} of size "
            f"{found[1]}, images {found[2]}, depth {tuple(seen.depth.shape)}, confidence {tuple(seen.depth_conf.shape)}"
        )
    if not len(gaussians):
        raise ValueError("there are no Gaussians to refine")
    if not seen.shown().any():
        raise ValueError("the masks of all views hide every pixel: there is nothing to refine on; check the masks")
    with torch.enable_grad():
        return _Refinement(gaussians, cameras, seen, renderer, options, clock, fold, points).run(observe)


class _Refinement:
    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        seen: Observations,
        renderer: Renderer,
        options: RefineOptions,
        clock: Callable[[], float],
        fold: Tensor | None = None,
        points: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.seen, self.renderer, self.clock = seen, renderer, clock
        self.began = clock()
        self.trained, self.held_out = split_views(seen, options.holdout, fold)
        self.order = ViewOrder(self.trained, options.seed)
        self.options = options.of(len(self.trained))
        loss = self.options.loss
        self.scoring = loss if self.options.geometry_every == 1 else loss.with_geometry(0)  # renders twice as fast
        start = gaussians
        if options.min_views:
            start = supported(gaussians, cameras, seen.depth, options.min_views, options.merge_cells, renderer)
        visible = seen.depth[seen.depth > 0]
        self.depth = float(visible.median()) if len(visible) else 1.0
        self.pixel = 1 / float(cameras.intrinsics[..., [0, 1], [0, 1]].mean())
        ones = torch.ones_like(seen.images[:, :, 0, 0])
        self.given, self.start = (
            RefinedScene(each, cameras, ones, torch.zeros_like(ones)).with_degree(options.sh_degree).detach()
            for each in (gaussians, start)
        )
        views = torch.arange(len(ones))
        self.given_loss, self.given_psnr = self._score(self.given, views)
        self.start_loss, self.start_psnr = self._score(self.start, views)
        self.best, self.best_score, self.best_step = self.start, 1.0, 0
        self.scores: list[float] = []
        self.recent: list[float] = []
        self.steps = 0
        begun = self.start
        if points is not None:
            begun = replace(begun, gaussians=with_points(begun.gaussians, *points))
        if options.fill:
            room = int(_MAX_GROWTH * len(start)) - len(start)
            filled = fill_holes(begun.gaussians, cameras, seen, renderer, self.trained, options.fill, room)
            begun = replace(begun, gaussians=filled)
        self.parameters = Parameters(begun, options.rates, self.pixel, self.depth, self.trained)
        if loss.opacity:
            note_seen(self.parameters, self.trained, renderer)

    def run(self, observe: Observer | None) -> Refined:
        """Runs steps and checks until the refinement ends."""
        ended = ""
        try:
            while not ended:
                ended = self._step()
                if observe is not None:
                    recent = self.recent[-20:]
                    observe(Progress(self.steps, self._done(), sum(recent) / len(recent), self.parameters.present))
        except KeyboardInterrupt:
            ended = "interrupted"
        loss, after = self._score(self.best, torch.arange(len(self.seen.images)))
        trained = self.trained
        if not loss[trained].mean() <= self.start_loss[trained].mean():  # left-out views can improve by chance
            self.best, self.best_step, loss, after = self.start, 0, self.start_loss, self.start_psnr
        closer = after[trained].mean() > self.given_psnr[trained].mean()
        if not (closer or loss[trained].mean() <= self.given_loss[trained].mean()):
            # too few steps to make up for the Gaussians that were left out at the start
            self.best, self.best_step, after = self.given, 0, self.given_psnr
        elif self.options.rates.cameras and self.best_step:
            self.best = self.best.seen_from(self.given.cameras.world_to_camera[0, 0])
        return Refined(
            start=self.given,
            scene=self.best,
            step=self.best_step,
            steps=self.steps,
            seconds=self.clock() - self.began,
            ended=ended,
            psnr=torch.stack((self.given_psnr, after)),
            trained=trained,
            held_out=self.held_out,
        )

    def _done(self) -> float:
        return self.options.done(self.steps, self.clock() - self.began)

    def _step(self) -> str:
        """Runs one step, and a check if one is due; returns how the refinement ended, or an empty string."""
        scene = self.parameters.scene()
        every = self.options.geometry_every
        of_step = self.options.loss.with_geometry(0 if self.steps % every else every)
        view = self.order.deal().to(self.seen.images.device)
        loss, images = _view_loss(scene, self.seen, self.renderer, of_step, view, self.depth)
        if terms := of_step.of_gaussians(scene.gaussians, self.parameters.seen):
            loss = loss + of_step.total(terms)
        self.recent.append(float(images.mean()))
        self.steps += 1
        if not self.parameters.step(loss, FINAL_RATE ** self._done()):
            return self._diverged("the loss or its gradient is not finite")
        done = self._done()
        if done < 1 and self.steps % self.options.check_every:
            return ""
        if trouble := self._check():
            return self._diverged(trouble)
        if done < 1:
            self.parameters.prune()
            self.order.next_round()
            return ""
        return "steps" if self.steps == self.options.steps else "seconds"

    def _score(self, scene: RefinedScene, views: Tensor) -> tuple[Tensor, Tensor]:
        """Returns loss and PSNR ``[R]`` of views, each rendered on its own."""
        return _view_losses(scene, self.seen, self.renderer, self.scoring, views, self.depth)

    def _check(self) -> str:
        """Scores the current state and keeps it if it is the best; returns what is wrong if it diverges."""
        scene = self.parameters.scene().detach()
        views = self.order.left_out if len(self.order.left_out) else self.trained
        loss, _ = self._score(scene, views)
        score = float((loss / self.start_loss[views]).mean())
        if not math.isfinite(score):
            return "the loss is not finite"
        if score > _WORSE:
            best, _ = self._score(self.best, views)
            if score > _WORSE * float((best / self.start_loss[views]).mean()):
                return f"the loss of the left-out views is {score:.1f} times the initial one"
        self.scores = [*self.scores, score][-SMOOTH:]
        smooth = sum(self.scores) / len(self.scores)
        if smooth <= self.best_score:
            self.best, self.best_score, self.best_step = scene, smooth, self.steps
        return ""

    def _diverged(self, trouble: str) -> str:
        log.warning("refinement, step %d: %s; the result is step %d", self.steps, trouble, self.best_step)
        return "diverged"


def split_views(seen: Observations, holdout: int | None, fold: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Returns the indices of the views to train on, and of the others; views that are masked as a whole are neither.

    Args:
        seen: observations of V views.
        holdout: do not train on every N-th view; None: train on all.
        fold: ``[F]`` further views not to train on; None: none.
    """
    every, shown = torch.arange(len(seen.images)), seen.shown()
    others = torch.zeros_like(shown) if holdout is None else every % holdout == holdout - 1
    if fold is not None:
        others |= torch.isin(every, fold)
    return every[shown & ~others], every[shown & others]


class ViewOrder:
    """Deals views in random order, each once before any repeats; some are left out, in rotation.

    Args:
        trained: ``[N]`` views to deal.
        seed: random seed of the order.

    Attributes:
        left_out: views that are not dealt at present.
    """

    def __init__(self, trained: Tensor, seed: int) -> None:
        self.trained = trained
        self._generator = torch.Generator().manual_seed(seed)
        self._left_out = self._rotation()
        self._hand: list[int] = []
        self.next_round()

    def next_round(self) -> None:
        """Moves on to the next views to leave out."""
        self.left_out = next(self._left_out)

    def deal(self) -> Tensor:
        """Returns the next view ``[1]``."""
        while True:
            if not self._hand:
                order = torch.randperm(len(self.trained), generator=self._generator)
                self._hand = self.trained[order].tolist()
            view = self._hand.pop()
            if view not in self.left_out.tolist():
                return torch.tensor([view])

    def _rotation(self) -> Iterator[Tensor]:
        if len(self.trained) < FEWEST:
            while True:
                yield self.trained[:0]
        order = self.trained[torch.randperm(len(self.trained), generator=self._generator)]
        while True:
            yield from order.split(-(-len(order) // _LEFT_OUT))
