"""``vg2gt refine``: optimises a reconstructed scene on its own images."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vg2gt.cli.arguments import add_common_flags, flag_parser, listing, separate
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.outputs.output_names import DEFAULT, OUTPUTS

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene
    from vg2gt.refinement import RefineOptions

HOW = "\nrefine=NAME (see configs/refine) and refine.key=value set the options; default: depends on the scene's cameras"
ADVICE = "fewer or smaller images (vg2gt reconstruct --max-images, --size) or fewer Gaussians"


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    arguments = flag_parser("refine", HOW + listing(OUTPUTS))
    add = arguments.add_argument
    add("scene", metavar="DIR", help="a folder that vg2gt reconstruct has written")
    add("--out", metavar="DIR", help="where to write; default: refined/ in the scene's folder")
    add("--steps", type=int, metavar="N", help="number of steps; default: 12 per view, 400 for photos")
    add("--seconds", type=float, metavar="S", help="stop after S seconds, or after --steps if that comes first")
    add("--holdout", type=int, metavar="N", help="exclude every N-th view and print its PSNR before and after")
    add_common_flags(arguments, DEFAULT)
    given, overrides = separate(argv)
    options = arguments.parse_args(given)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with errors_in_one_line():
        run(options, overrides)


def run(options: argparse.Namespace, overrides: Sequence[str]) -> None:
    """Refines a scene and writes the outputs."""
    from vg2gt.memory import memory_advice
    from vg2gt.monitor import Monitor
    from vg2gt.outputs.outputs import check_folder, check_outputs, write_outputs
    from vg2gt.outputs.saved import read_scene
    from vg2gt.reconstruction.refined import refine_scene, refinement_lines
    from vg2gt.rendering import Renderer
    from vg2gt.runs.load import choose_device

    check_outputs(options.save)
    out = Path(options.out or Path(options.scene) / "refined")
    check_folder(out, options.save, options.overwrite)
    refine_options("default", overrides)  # reports wrong options before anything is read
    device = choose_device(options.device)
    with Monitor(show=not options.quiet, device=device) as monitor, memory_advice(ADVICE):
        with monitor.stage("read scene"):
            scene = read_scene(options.scene, Renderer(mode=options.mode), device)
        how = options_for(scene, overrides, steps=options.steps, seconds=options.seconds, holdout=options.holdout)
        scene = refine_scene(scene, how, monitor)
        folder = write_outputs(scene, out, options.save, overwrite=options.overwrite, monitor=monitor)
    print(*refinement_lines(scene), sep="\n")
    print(f"written: {', '.join(str(folder / name) for name in options.save)}")


def options_for(scene: Scene, overrides: Sequence[str] = (), **changes: float | None) -> RefineOptions:
    """Returns the refinement options of a scene.

    The defaults depend on the scene's cameras; ``overrides`` change them, then ``changes`` that are not None. Seconds
    alone replace the default steps. Predicted cameras are refined unless there are overrides.
    """
    from vg2gt.reconstruction.refined import refinement_of
    from vg2gt.refinement import RefineRates

    found = refine_options(refinement_of(scene), overrides)
    if not overrides and not scene.cameras_from:
        found = replace(found, rates=replace(found.rates, cameras=RefineRates().cameras))
    given: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
    return replace(found, **({"steps": None} if "seconds" in given else {}) | given)


def refine_options(name: str, overrides: Sequence[str]) -> RefineOptions:
    """Builds the options of ``refine=NAME refine.key=value``; ``name`` is used if the overrides choose none."""
    from hydra.utils import instantiate

    from vg2gt.config import compose_groups

    chosen = any(override.startswith("refine=") for override in overrides)
    return instantiate(compose_groups(*([] if chosen else [f"refine={name}"]), *overrides).refine)
