"""Refinement of a scene on its own images, and its report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vg2gt.io.images import colorize_normals, grid
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import spread
from vg2gt.refinement import Observations, RefinedScene, RefineOptions, refine

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

ROWS = 4
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
    return replace(scene, gaussians=refined.scene.gaussians, cameras=refined.scene.cameras, refined=refined)


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
        "retreats": refined.retreats,
        "gaussians_before": len(refined.start.gaussians),
        "gaussians_after": len(refined.scene.gaussians),
    }
    for name, views in (("trained", refined.trained), ("held_out", refined.held_out)):
        if len(views):
            before, after = (round(float(psnr), 3) for psnr in refined.psnr[:, views].mean(1))
            figures |= {f"psnr_{name}_before": before, f"psnr_{name}_after": after}
    return {"refinement": figures}


def refinement_lines(scene: Scene) -> list[str]:
    """Returns a short table of a refinement (views, PSNR before and after, Gaussians); empty if there was none."""
    refined, lines = scene.refined, []
    if refined is None:
        return lines
    for name, views in (("trained on", refined.trained), ("held out", refined.held_out)):
        if len(views):
            before, after = refined.psnr[:, views].mean(1).tolist()
            lines.append(f"{name:<11} {len(views):>4} views: {before:6.2f} -> {after:6.2f} dB")
    before, after = len(refined.start.gaussians), len(refined.scene.gaussians)
    ended = {"interrupted": ", interrupted", "diverged": ", stopped because it diverged"}.get(refined.ended, "")
    lines.append(f"best state: step {refined.step} of {refined.steps}{ended}; Gaussians: {before} -> {after}")
    return lines


@torch.no_grad()
def before_and_after(scene: Scene) -> Tensor:
    """Renders an image ``[3, H', W']`` of up to 4 views, held-out ones first.

    Columns: image, rendered colour before and after, normals before and after.
    """
    refined = scene.refined
    assert refined is not None
    trained = refined.trained[torch.tensor(sorted(spread(len(refined.trained), min(ROWS, len(refined.trained)))))]
    views = torch.cat((refined.held_out, trained))[:ROWS]

    def panels(state: RefinedScene, view: Tensor) -> tuple[Tensor, Tensor]:
        view = view.to(state.gaussians.means.device)
        shown = scene.renderer(state.gaussians, state.cameras.select(view)).to("cpu")
        return shown.color[0, 0].clamp(0, 1), colorize_normals(shown.normal[0, 0])

    rows = []
    for view in views.split(1):
        before, after = (panels(state, view) for state in (refined.start, refined.scene))
        rows.append([scene.images[int(view)], before[0], after[0], before[1], after[1]])
    return grid(rows)
