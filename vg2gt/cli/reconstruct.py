"""``vg2gt reconstruct``: makes a scene from images, a folder of them or a video."""

from __future__ import annotations

import argparse
import logging
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.cli.arguments import (
    WATCH,
    add_common_flags,
    flag_parser,
    list_of_names,
    separate,
    watching,
    without_patterns,
)
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.outputs.output_names import DEFAULT, LARGE, OUTPUTS, PREDICTED, TILES, check_outputs
from vg2gt.reconstruction.windows import WINDOWS

_USAGE = "vg2gt reconstruct IMAGES... --out DIR [options] [KEY=VALUE ...]"
DETAILS = """
KEY=VALUE sets model, backend, renderer and refinement: backend=da3_small,
model.fine.max_voxels=500000, refine.full.size=1008"""

if TYPE_CHECKING:
    from vg2gt.monitor import Monitor
    from vg2gt.reconstruction.pipeline import Pipeline
    from vg2gt.reconstruction.scene import Scene


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    arguments = _parser()
    given, overrides = separate(argv)
    options = arguments.parse_args(given)
    options.images = without_patterns(options.images)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with errors_in_one_line():
        if options.each:
            from vg2gt.cli.captures import reconstruct_each

            reconstruct_each(options, overrides, run)
        else:
            run(options, overrides)


def _parser() -> argparse.ArgumentParser:
    """Returns the parser of the options, which its help groups by what they are about."""
    parser = flag_parser("reconstruct", DETAILS, _USAGE)
    parser.add_argument("images", nargs="+", metavar="IMAGES", help="image files, a folder of them, a video, or a "
        "recording with known cameras")  # fmt: skip
    add = parser.add_argument_group("input").add_argument
    add("--size", type=_size, metavar="N|HxW", help="longer side, or height and width, in pixels at which the model "
        "works; default: 518, on a CPU 392 (many: 280)")  # fmt: skip
    add("--max-images", type=int, metavar="N", help="use at most N, evenly spaced; default: all, 32 of a video")
    add("--poses", choices=("auto", "given", "sfm"), default="auto", metavar="SOURCE", help="cameras: given (files "
        "next to the images), sfm (structure from motion) or auto (default: given if there are any)")  # fmt: skip
    add("--window", type=int, metavar="N", help="process N images at a time, which limits the memory; 0: all at once; "
        "default: 24 for more than 100 images")  # fmt: skip
    add("--each", action="store_true", help="IMAGES are captures (folders, videos or a .txt file that lists them); "
        "each makes a scene in DIR/NAME")  # fmt: skip
    add = parser.add_argument_group("model").add_argument
    add("--ckpt", metavar="PATH", help="a checkpoint or a run's folder; default: the weights in the package for "
        "backend=sweep, an untrained head for others")  # fmt: skip
    add("--calibration", metavar="FILE", help="depth errors by vg2gt calibrate; default: next to the checkpoint")
    add = parser.add_argument_group("refinement of up to 100 photographs, on by default").add_argument
    add("--quality", choices=("draft", "normal", "high"), default="normal", metavar="NAME", help="draft (working size "
        "only), normal (default: then at the photographs' own size) or high (with six times the steps)")  # fmt: skip
    add("--refine", type=int, metavar="N", help="refine any scene for N steps at the working size only; 0: not at all")
    add("--watch", action="store_true", help=WATCH)
    add = parser.add_argument_group("what to keep").add_argument
    add("--object", action="store_true", help="only the object that the cameras look at")
    add("--min-confidence", type=float, metavar="C", help="only Gaussians whose depth error is at most 1 - C")
    add("--drop", type=list_of_names, default=[], metavar="LIST", help="no Gaussians with these statuses: guessed, "
        "contradicted, single (seen by one view), unseen")  # fmt: skip
    add = parser.add_argument_group("output").add_argument
    add("--out", metavar="DIR", required=True, help="where to write")
    add_common_flags(add, DEFAULT, OUTPUTS)
    add("--mesh-voxel", type=float, metavar="X", help="edge of the mesh's voxels in scene units")
    return parser


def run(options: argparse.Namespace, overrides: Sequence[str]) -> Scene:
    """Reconstructs a scene, writes the outputs and returns it."""
    from vg2gt.api import load
    from vg2gt.io.gaussian_files import READERS
    from vg2gt.memory import RECONSTRUCTION, memory_advice
    from vg2gt.monitor import Monitor
    from vg2gt.outputs.outputs import cost_figures, write_outputs
    from vg2gt.reconstruction.frame import place_lines
    from vg2gt.reconstruction.policy import check_refinement
    from vg2gt.reconstruction.refined import refinement_lines
    from vg2gt.reconstruction.trust import trust_lines, trusted
    from vg2gt.reconstruction.windows.store import remove
    from vg2gt.runs.load import choose_device

    options.out = str(Path(options.out).expanduser())
    how_to_refine = [each for each in overrides if each.lstrip("+").startswith(("refine=", "refine."))]
    overrides = [each for each in overrides if each not in how_to_refine]
    _check(options, overrides)
    check_refinement(options.refine, options.quality, how_to_refine)
    with (
        watching(options.watch) as watch,
        Monitor(not options.quiet, choose_device(options.device), watch) as monitor,
    ):
        with monitor.stage("load model"):
            ready = load(options.ckpt, overrides=overrides, device=options.device)
        scene = _scene(options, ready, how_to_refine, monitor)
        scene = trusted(scene, options.min_confidence, options.drop)
        scene = scene.cut_to_object() if options.object else scene
        if len(scene.gaussians) > LARGE and TILES not in options.save:
            options.save.append(TILES)
        trained = bool(ready.model.trained_parameters())
        figures = {
            "model": type(ready.model).__name__,
            "backend": ready.model.backend.identity(),
            "weights": str(ready.weights) if trained else "none: the model has no trained part",
        }
        with memory_advice(RECONSTRUCTION):
            folder = write_outputs(
                scene,
                options.out,
                options.save,
                overwrite=options.overwrite,
                mesh_voxel=options.mesh_voxel,
                figures=figures,
                monitor=monitor,
            )
    remove(folder / WINDOWS)
    cost = cost_figures(monitor)
    times = ", ".join(f"{name} {seconds:.1f}" for name, seconds in cost["seconds"].items() if seconds >= 0.05)
    height, width = scene.cameras.size
    print(f"{len(scene.gaussians)} Gaussians from {len(scene.names)} images, which the model saw at {height}x{width}")
    if scene.refined is not None:
        print(*refinement_lines(scene), sep="\n")
    print(*trust_lines(scene), *place_lines(scene), sep="\n")
    print(f"weights: {figures['weights']}; cameras: {scene.cameras_from or PREDICTED}")
    print(f"seconds: {times}; peak memory {cost['peak_memory_mib']} MiB")
    print(f"written: {', '.join(str(folder / name) for name in options.save)}")
    if any(f"scene{suffix}" in options.save for suffix in READERS):
        levels = " --levels" * (len(scene.gaussians) > LARGE)
        print(f"to look at it: vg2gt view {shlex.quote(str(folder))}{levels} --open")
    return scene


def _check(options: argparse.Namespace, overrides: Sequence[str]) -> None:
    """Checks all arguments before weights are downloaded or any work is done."""
    from vg2gt.inputs.cameras import check_inputs
    from vg2gt.inputs.pictures import check_limit, count_pictures
    from vg2gt.outputs.outputs import check_folder, check_space
    from vg2gt.reconstruction.trust import check_trust
    from vg2gt.reconstruction.windows.store import window_size
    from vg2gt.runs.load import backend_class

    check_outputs(options.save)
    check_folder(options.out, options.save, options.overwrite)
    check_limit(options.max_images)
    window_size(options.window, 0)
    check_trust(options.min_confidence, options.drop)
    check_inputs(backend_class(options.ckpt, overrides), options.images, options.poses)
    check_space(options.out, options.save, count_pictures(options.images, options.max_images))


def _scene(options: argparse.Namespace, ready: Pipeline, overrides: Sequence[str], monitor: Monitor) -> Scene:
    """Makes the scene with the options of the command line."""
    from vg2gt.runs.load import find_calibration

    renderer = replace(ready.renderer, mode=options.mode)
    calibration = ready.calibration
    if options.calibration is not None:
        calibration = find_calibration(ready.model, ready.weights, options.calibration)
    return replace(ready, renderer=renderer, calibration=calibration).reconstruct(
        options.images,
        size=options.size,
        quality=options.quality,
        refine=options.refine,
        overrides=overrides,
        max_images=options.max_images,
        poses=options.poses,
        window=options.window,
        folder=options.out,
        monitor=monitor,
    )


def _size(text: str) -> int | tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(side.isdigit() and int(side) > 0 for side in sides):
        raise argparse.ArgumentTypeError(f"{text!r} is neither N nor HxW, such as 518 or 294x518")
    numbers = [int(side) for side in sides]
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])
