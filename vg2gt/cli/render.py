"""``vg2gt render``: renders a scene file from given cameras: colour, depth, normals, an animation."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from vg2gt.cli.arguments import add_common_flags, flag_parser, listing
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.outputs.output_names import FPS, MAPS

OUTPUTS = {**MAPS, "video.gif": "the colour of all views as an animation", "video.mp4": "the same as H.264"}
DEFAULT = ("color.png",)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    arguments = flag_parser("render", listing(OUTPUTS))
    add = arguments.add_argument
    add("scene", help="scene.ply or .spz")
    add(
        "--cameras",
        required=True,
        metavar="PATH",
        help="cameras.json, transforms.json, or a COLMAP model's folder",
    )
    add("--out", required=True, metavar="DIR", help="where to write")
    add("--depth", choices=("median", "expected"), default="median", help="expected requires --mode rasterized")
    add("--interpolate", type=int, metavar="N", help="interpolate smoothly, with N new cameras between each pair")
    add("--fps", type=float, default=FPS, help=f"frame rate of the animation, default {FPS:g}")
    add("--near", type=float, help="near plane in scene units; default: that of report.json next to it, else 0.01")
    add_common_flags(arguments, DEFAULT)
    options = arguments.parse_args(argv)
    with errors_in_one_line():
        run(options)


def run(options: argparse.Namespace) -> None:
    """Renders the views and writes the outputs."""
    from vg2gt.inputs.camera_files import interpolate, read_cameras
    from vg2gt.io import read_gaussians
    from vg2gt.io.video import require_pyav
    from vg2gt.monitor import Monitor
    from vg2gt.outputs.outputs import animation, check_folder, check_outputs, cost_figures, feed, map_folder
    from vg2gt.outputs.saved import near_of
    from vg2gt.reconstruction.scene import render_views
    from vg2gt.rendering import Renderer
    from vg2gt.runs.load import choose_device

    outputs = options.save
    check_outputs(outputs, OUTPUTS)
    if "video.mp4" in outputs:
        require_pyav("writing video.mp4")
    cameras = read_cameras(options.cameras)
    if not cameras:
        raise ValueError(f"{options.cameras} names no camera; there is nothing to render")
    cameras = cameras if options.interpolate is None else interpolate(cameras, options.interpolate)
    gaussians = read_gaussians(options.scene).to(choose_device(options.device))
    if not len(gaussians):
        raise ValueError(f"{options.scene} holds no Gaussians; there is nothing to render")
    near = near_of(Path(options.scene).parent, Renderer().near) if options.near is None else options.near
    renderer = Renderer(mode=options.mode, depth=options.depth, near=near)
    folder = check_folder(options.out, outputs, options.overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    sinks = [map_folder(folder, name) for name in outputs if name in MAPS]
    sinks += [animation(folder / name, options.fps) for name in outputs if name.startswith("video")]
    monitor = Monitor(show=not options.quiet, device=gaussians.means.device)
    with monitor, monitor.stage("render views", len(cameras)) as advance:
        feed(render_views(renderer, gaussians, cameras), sinks, advance)
    cost = cost_figures(monitor)
    seconds = sum(cost["seconds"].values())
    print(f"{len(cameras)} views of {len(gaussians)} Gaussians: {seconds:.1f} s, peak {cost['peak_memory_mib']} MiB")
    print(f"written: {', '.join(str(folder / name) for name in outputs)}")
