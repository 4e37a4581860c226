"""``vg2gt refine``: optimises a reconstructed scene on its own images."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from vg2gt.cli.arguments import WATCH, add_common_flags, flag_parser, separate, watching
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.outputs.output_names import DEFAULT, OUTPUTS, check_outputs

_HOW = """
refine=NAME selects a file of configs/refine, refine.KEY=VALUE changes a key.
Default: photographs, or default for RGB-D recordings."""
ADVICE = "fewer or smaller images (vg2gt reconstruct --max-images, --size) or fewer Gaussians"


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    arguments = flag_parser("refine", _HOW)
    add = arguments.add_argument
    add("scene", metavar="DIR", help="a folder that vg2gt reconstruct has written")
    add("--out", metavar="DIR", help="where to write; default: refined/ in the scene's folder")
    add("--steps", type=int, metavar="N", help="number of steps; default: 12 per view, 240 for photographs")
    add("--seconds", type=float, metavar="S", help="stop after S seconds, or after --steps if that comes first")
    add("--holdout", type=int, metavar="N", help="exclude every N-th view and print its PSNR before and after")
    add("--watch", action="store_true", help=WATCH)
    add_common_flags(add, DEFAULT, OUTPUTS)
    given, overrides = separate(argv)
    options = arguments.parse_args(given)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with errors_in_one_line():
        run(options, overrides)


def run(options: argparse.Namespace, overrides: Sequence[str]) -> None:
    """Refines a scene and writes the outputs."""
    from vg2gt.memory import memory_advice
    from vg2gt.monitor import Monitor
    from vg2gt.outputs.outputs import check_folder, write_outputs
    from vg2gt.outputs.saved import read_scene
    from vg2gt.reconstruction.policy import read_options, refinement_for
    from vg2gt.reconstruction.refined import refine_scene, refinement_lines
    from vg2gt.rendering import Renderer
    from vg2gt.runs.load import choose_device

    check_outputs(options.save)
    out = Path(options.out or Path(options.scene) / "refined")
    check_folder(out, options.save, options.overwrite)
    read_options("default", overrides)  # reports wrong options before anything is read
    device = choose_device(options.device)
    with watching(options.watch) as watch, Monitor(not options.quiet, device, watch) as monitor, memory_advice(ADVICE):
        with monitor.stage("read scene"):
            scene = read_scene(options.scene, Renderer(mode=options.mode), device)
        changes = {"steps": options.steps, "seconds": options.seconds, "holdout": options.holdout}
        how = refinement_for(scene, overrides=overrides, **changes)
        scene = refine_scene(scene, how, monitor)
        folder = write_outputs(scene, out, options.save, overwrite=options.overwrite, monitor=monitor)
    print(*refinement_lines(scene), sep="\n")
    print(f"written: {', '.join(str(folder / name) for name in options.save)}")
