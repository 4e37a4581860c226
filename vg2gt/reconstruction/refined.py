"""Refinement of a scene on its own images, and its report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vg2gt.monitor import Monitor
from vg2gt.reconstruction.surroundings import without_debris
from vg2gt.refinement import Observations, RefineOptions, refine

if TYPE_CHECKING:
    from torch import Tensor

    from vg2gt.reconstruction.scene import Scene

RECORDINGS = ("RGBDFolder", "TUM")  # their measured poses fit their depth better than bundle adjustment does


def refinement_of(scene: Scene) -> str:
    """Returns the configuration in ``configs/refine`` for a scene: ``default`` for RGB-D, else ``photographs``."""
    return "default" if scene.cameras_from.startswith(RECORDINGS) else "photographs"


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
    device = scene.gaussians.means.device
    seen = Observations(scene.images, scene.depth, scene.depth_conf, scene.mask).to(device)
    with (monitor or Monitor()).stage("refine", 100) as advance:

        def observe(_: int, done: float, psnr: float) -> None:
            advance(100 * done, f"{psnr:.2f} dB")

        refined = refine(scene.gaussians, scene.cameras, seen, scene.renderer, options, observe, clock)
    made = replace(scene, gaussians=refined.scene.gaussians, cameras=refined.scene.cameras, refined=refined)
    return without_debris(made)


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
    for when, state, psnr in zip(("before", "after"), (refined.start, refined.scene), refined.psnr, strict=True):
        figures[f"gaussians_{when}"] = len(state.gaussians)
        for name, views in (("trained", refined.trained), ("held_out", refined.held_out)):
            if len(views):
                figures[f"psnr_{name}_{when}"] = round(_mean(psnr[views]), 3)
    return {"refinement": figures}


def _mean(psnr: Tensor) -> float:
    """Returns the mean PSNR ``[V]`` over the views of which not all pixels are masked; 0 if there are none."""
    return float(psnr[psnr.isfinite()].mean()) if psnr.isfinite().any() else 0.0


def refinement_lines(scene: Scene) -> list[str]:
    """Returns a short table of a refinement (views, PSNR before and after, Gaussians); empty if there was none."""
    refined, lines = scene.refined, []
    if refined is None:
        return lines
    for name, views in (("trained on", refined.trained), ("held out", refined.held_out)):
        if len(views):
            before, after = (_mean(psnr[views]) for psnr in refined.psnr)
            lines.append(f"{name:<11} {len(views):>4} views: {before:6.2f} -> {after:6.2f} dB")
    before, after = len(refined.start.gaussians), len(refined.scene.gaussians)
    ended = {"interrupted": ", interrupted", "diverged": ", stopped because it diverged"}.get(refined.ended, "")
    lines.append(f"best state: step {refined.step} of {refined.steps}{ended}; Gaussians: {before} -> {after}")
    return lines
