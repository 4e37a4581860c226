"""Refinement of a scene on its own images, and its report."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vg2gt.memory import RECONSTRUCTION, memory_advice, note_sizes
from vg2gt.monitor import Monitor
from vg2gt.reconstruction.photographs import load_photographs, of_full_size, sparse_points
from vg2gt.reconstruction.policy import Quality, Refinement, chosen_refinement
from vg2gt.reconstruction.surroundings import without_debris
from vg2gt.refinement import (
    Observations,
    RefineOptions,
    exposure_rates,
    fold_of,
    refine,
    sharpened,
    split_views,
)
from vg2gt.refinement.options import Observer, Progress
from vg2gt.refinement.parameters import RefinedScene
from vg2gt.types import Cameras, Gaussians

if TYPE_CHECKING:
    from torch import Tensor

    from vg2gt.reconstruction.scene import Scene

log = logging.getLogger(__name__)

_USABLE = 17.0  # dB; scenes below it look like fog
_WORKING_SHARE = 0.45  # of the time, at most, for the stage at the working size


def refine_scene(
    scene: Scene,
    options: RefineOptions,
    monitor: Monitor | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Scene:
    """Optimises a scene's Gaussians and cameras on its images (:func:`vg2gt.refinement.refine`).

    Args:
        scene: scene to start from; it is not changed.
        options: options of the refinement.
        monitor: shows PSNR and the time left.
        clock: measures the options' seconds; ``time.process_time`` counts those of all cores.

    Returns:
        The refined scene, with the same images, decoded depth and names.
    """
    monitor, began = monitor or Monitor(), clock()
    device = scene.gaussians.means.device
    seen = Observations(scene.images, scene.depth, scene.depth_conf, scene.mask).to(device)
    rates = exposure_rates(options.rates, scene.gaussians, scene.cameras, seen, scene.renderer)
    options = replace(options, rates=rates)
    full = of_full_size(scene, options)
    at_working_size = options
    if full is not None and options.seconds is not None:
        at_working_size = replace(options, seconds=_WORKING_SHARE * options.seconds)
    fold = None if full is None else fold_of(split_views(seen, options.holdout)[0], full)
    with monitor.stage("refine", 100, " %") as advance:
        observe = _shown(advance, monitor)
        start = (scene.gaussians, scene.cameras, seen, scene.renderer)
        refined = refine(*start, at_working_size, observe, clock, fold, sparse_points(scene))
    if full is not None and refined.ended in ("steps", "seconds"):
        try:
            photographs = load_photographs(scene.pictures, refined.scene.cameras, full.size, monitor).to(device)
            left = None if options.seconds is None else options.seconds - (clock() - began)
            if left is None or left > 0:
                with monitor.stage("refine at full size", 100, " %") as advance:
                    observe = _shown(advance, monitor)
                    refined = sharpened(refined, photographs, seen, scene.renderer, options, left, observe, clock)
            else:
                log.warning("no time is left to refine at full size: allow more than %g seconds", options.seconds)
        except KeyboardInterrupt:  # before or after its steps
            refined = replace(refined, ended="interrupted")
    made = replace(
        scene,
        gaussians=refined.scene.gaussians,
        cameras=refined.scene.cameras,
        refined=refined,
        renderer=scene.renderer if refined.sharpened is None else refined.sharpened.renderer,
    )
    return without_debris(made)


def refined_by_policy(
    scene: Scene,
    refine: Refinement = None,
    quality: Quality = "normal",
    overrides: Sequence[str] = (),
    monitor: Monitor | None = None,
) -> Scene:
    """Refines a scene if :func:`vg2gt.reconstruction.policy.chosen_refinement` says so; arguments as there.

    Raises:
        OutOfMemory: if the device's memory is full; the message says what takes less.
    """
    options = chosen_refinement(scene, refine, quality, overrides)
    if options is None:
        return scene
    height, width = scene.cameras.size
    with memory_advice(RECONSTRUCTION):
        note_sizes({f"images of {height}x{width}": len(scene.names), "Gaussians": len(scene.gaussians)})
        return refine_scene(scene, options, monitor)


def _shown(advance: Callable[..., None], monitor: Monitor) -> Observer:
    def observe(progress: Progress) -> None:
        advance(100 * progress.share, f"{progress.psnr:.2f} dB")
        if monitor.watch is not None:
            monitor.watch(lambda: _seen(progress.scene()))

    return observe


def _seen(scene: RefinedScene) -> tuple[Gaussians, Cameras]:
    return scene.gaussians, scene.cameras


def refinement_figures(scene: Scene) -> dict[str, Any]:
    """Returns the report entries of a scene's refinement; empty if it was not refined."""
    refined = scene.refined
    if refined is None:
        return {}
    figures: dict[str, Any] = {
        "steps": refined.steps,
        "best_step": refined.step,
        "seconds": round(refined.seconds, 2),
        "ended": refined.ended,
    }
    if (sharp := refined.sharpened) is not None:
        height, width = sharp.scene.cameras.size
        figures["full_size"] = {"image": [height, width], "steps": sharp.steps, "ended": sharp.ended}
        if sharp.score is not None:
            figures["full_size"] |= {"psnr_left_out": round(sharp.score, 3), "left_out": list(sharp.fold)}
    for when, state, psnr in zip(("before", "after"), (refined.start, refined.scene), refined.psnr, strict=True):
        figures[f"gaussians_{when}"] = len(state.gaussians)
        for name, views in (("trained", refined.trained), ("held_out", refined.held_out)):
            if len(views):
                figures[f"psnr_{name}_{when}"] = round(_mean(psnr[views]), 3)
    return {"refinement": figures}


def _mean(psnr: Tensor) -> float:
    """Returns the mean PSNR ``[V]`` over the views of which not all pixels are masked; 0 if there are none."""
    return float(psnr[psnr.isfinite()].mean()) if psnr.isfinite().any() else 0.0


def _judged(psnr: float, views: int) -> str:
    """Says how good a scene is by the PSNR of views before they were trained, and what may be wrong if it is not."""
    which = "1 photograph that was" if views == 1 else f"{views} photographs that were"
    said = f"new views: PSNR of about {psnr:.1f} dB, measured on {which} left out at first"
    if psnr >= _USABLE:
        return said
    return (
        f"{said}; this is hardly usable. Likely causes: the photographs are too far apart (take more, in smaller "
        "steps), the object turned before a visible room (mask the background), something moved, or cameras are wrong "
        "(try --poses sfm)"
    )


def refinement_lines(scene: Scene) -> list[str]:
    """Returns a short table of a refinement (views, PSNR before and after, Gaussians); empty if there was none."""
    refined, lines = scene.refined, []
    if refined is None:
        return lines
    for name, views in (("trained on", refined.trained), ("held out", refined.held_out)):
        if len(views):
            before, after = (_mean(psnr[views]) for psnr in refined.psnr)
            lines.append(f"{name:<11} {len(views):>4} views: {before:6.2f} -> {after:6.2f} dB")
    if (sharp := refined.sharpened) is not None and sharp.score is not None:
        lines.append(_judged(sharp.score, len(sharp.fold)))
    before, after = len(refined.start.gaussians), len(refined.scene.gaussians)
    ended = {"interrupted": " (interrupted)", "diverged": " (stopped because it diverged)"}.get(refined.ended, "")
    kept = f"; the scene after step {refined.step} was the best and is kept" if refined.step < refined.steps else ""
    if refined.step == 0:
        kept = "; no step was better than the scene before, which is kept"
    lines.append(f"refined for {refined.steps} steps{ended}{kept}; Gaussians: {before} -> {after}")
    return lines
