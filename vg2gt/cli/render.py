"""``vg2gt render``: renders a scene: colour, depth and normals of given cameras, or a video along a path."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.cli.arguments import add_common_flags, flag_parser
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.outputs.output_names import FPS, MAPS, check_outputs

OUTPUTS = {**MAPS, "video.gif": "the colour of all views as an animation", "video.mp4": "the same as H.264"}
DEFAULT, MOVING = ("color.png",), ("video.mp4",)
_COLORS = {"color.png", "video.gif", "video.mp4"}  # outputs that need no depth and normals
CAMERAS = "cameras.json"  # next to the scene, as vg2gt reconstruct writes it
_NOTES = {
    "orbit": "an orbit around what the cameras look at",
    "swing": "an orbit to and fro, because all cameras are on one side of what they look at",
    "path": "a path through the cameras",
    "file": "the frames of the file",
}
_MAX_SIZE = 16384

if TYPE_CHECKING:
    from vg2gt.io.cameras_json import NamedCamera
    from vg2gt.reconstruction.camera_path import CameraPath
    from vg2gt.rendering import Renderer
    from vg2gt.types import Gaussians


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    arguments = flag_parser("render")
    add = arguments.add_argument
    add("scene", help="a scene's folder, scene.ply, .spz, .glb or .gltf")
    motion = arguments.add_mutually_exclusive_group().add_argument
    motion("--cameras", metavar="PATH", help="cameras.json, transforms.json, or a COLMAP model's folder; default: the "
        "cameras.json next to the scene")  # fmt: skip
    motion("--orbit", action="store_true", help="turn around what the cameras look at, or follow them inside a room; "
        "writes video.mp4 by default, like --path")  # fmt: skip
    motion("--path", metavar="FILE", help="nerfstudio's camera_path.json, or cameras (such as views saved by the "
        "viewer) to move through")  # fmt: skip
    add("--out", metavar="DIR", help="where to write; default: the scene's folder")
    add("--size", type=_size, metavar="WxH", help="width and height; default: those of the cameras, 1280x720 of videos")
    add("--seconds", type=_positive, metavar="S", help="duration of --orbit or --path; default: by its length")
    add("--depth", choices=("median", "expected"), default="median", help="expected requires --mode rasterized")
    add("--interpolate", type=int, metavar="N", help="interpolate smoothly, with N new cameras between each pair")
    add(
        "--fps",
        type=_positive,
        metavar="N",
        help=f"frames per second; default: those of camera_path.json, else {FPS:g}",
    )
    add("--near", type=float, help="near plane in scene units; default: that of report.json next to it, else 0.01")
    add_common_flags(add, DEFAULT, OUTPUTS)
    arguments.set_defaults(save=None)
    options = arguments.parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with errors_in_one_line():
        run(options)


def run(options: argparse.Namespace) -> None:
    """Renders the views and writes the outputs."""
    from vg2gt.inputs.scene_cameras import cameras_of_scene
    from vg2gt.io import read_gaussians
    from vg2gt.io.video import require_pyav
    from vg2gt.monitor import Monitor
    from vg2gt.outputs.outputs import animation, check_folder, cost_figures, feed, map_folder
    from vg2gt.outputs.saved import renderer_of, scene_file
    from vg2gt.reconstruction.camera_path import CameraPath
    from vg2gt.reconstruction.scene import render_views
    from vg2gt.rendering import Renderer
    from vg2gt.runs.load import choose_device

    moving = options.orbit or options.path is not None
    outputs = list(MOVING if moving else DEFAULT) if options.save is None else options.save
    check_outputs(outputs, OUTPUTS)
    if "video.mp4" in outputs:
        require_pyav("writing video.mp4")
    if not moving and options.seconds is not None:
        raise ValueError("--seconds requires --orbit or --path; --fps sets the speed of views as they are")
    if moving and options.interpolate is not None:
        raise ValueError("--interpolate is for views as they are; --seconds and --fps set the frames of a path")
    scene = scene_file(options.scene)
    folder = check_folder(options.out or scene.parent, outputs, options.overwrite)
    still = None if moving else _still(options, scene)  # before the scene, which may take long to read
    gaussians = read_gaussians(scene).to(choose_device(options.device))
    if not len(gaussians):
        raise ValueError(f"{scene} holds no Gaussians; there is nothing to render")
    renderer = renderer_of(scene.parent, Renderer(mode=options.mode, depth=options.depth))
    if options.near is not None:
        renderer = replace(renderer, near=options.near)
    if still is None:
        path = _moving(options, scene, gaussians, renderer)
    else:
        path = CameraPath(cameras_of_scene(still, scene, gaussians), options.fps or FPS, "views")
    cameras, fps = path.cameras, path.fps
    if not set(outputs) - _COLORS:
        renderer = replace(renderer, geometry=False)
    folder.mkdir(parents=True, exist_ok=True)
    sinks = [map_folder(folder, name) for name in outputs if name in MAPS]
    sinks += [animation(folder / name, fps) for name in outputs if name.startswith("video")]
    monitor = Monitor(show=not options.quiet, device=gaussians.means.device)
    with monitor, monitor.stage("render views", len(cameras)) as advance:
        feed(render_views(renderer, gaussians, cameras), sinks, advance)
    cost = cost_figures(monitor)
    seconds = sum(cost["seconds"].values())
    print(f"{len(cameras)} views of {len(gaussians)} Gaussians: {seconds:.1f} s, peak {cost['peak_memory_mib']} MiB")
    if path.kind in _NOTES:
        print(f"{_NOTES[path.kind]}, {len(cameras) / fps:.1f} s at {fps:g} frames per second")
    print(f"written: {', '.join(str(folder / name) for name in outputs)}")


def _still(options: argparse.Namespace, scene: Path) -> list[NamedCamera]:
    """Returns the cameras of a file, resized and interpolated as asked."""
    from vg2gt.inputs.camera_files import interpolate, read_cameras
    from vg2gt.reconstruction.camera_path import resized

    source = options.cameras or scene.parent / CAMERAS
    if options.cameras is None and not source.is_file():
        raise ValueError(f"{scene.parent} has no {CAMERAS}: choose the cameras with --cameras, --orbit or --path")
    cameras = read_cameras(source)
    if not cameras:
        raise ValueError(f"{source} names no camera; there is nothing to render")
    if options.size is not None:
        cameras = [resized(camera, options.size) for camera in cameras]
    if options.interpolate is not None:
        cameras = interpolate(cameras, options.interpolate)
    return cameras


def _moving(options: argparse.Namespace, scene: Path, gaussians: Gaussians, renderer: Renderer) -> CameraPath:
    """Returns the frames of ``--orbit`` or ``--path``."""
    from vg2gt.inputs.camera_files import read_cameras
    from vg2gt.inputs.scene_cameras import cameras_of_scene
    from vg2gt.reconstruction.camera_path import SIZE, glide, median_depth, orbit, read_camera_path

    size, fps = options.size or SIZE, options.fps or FPS
    if options.path is None:
        known = scene.parent / CAMERAS
        found = orbit(gaussians, read_cameras(known) if known.is_file() else [], renderer, size, fps, options.seconds)
    elif found := read_camera_path(options.path, options.size, options.fps):
        if options.seconds is not None:
            raise ValueError(f"{options.path} sets the duration by its frames: leave --seconds away, or change --fps")
    else:
        cameras = cameras_of_scene(read_cameras(options.path), scene, gaussians)
        unit = median_depth(gaussians, cameras, renderer) or 1.0
        found = glide(cameras, unit, size, fps, options.seconds)
    return found


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdigit() and 0 < int(side) <= _MAX_SIZE for side in sides):
        raise argparse.ArgumentTypeError(f"{text!r} is not a width and height such as 1920x1080")
    return int(sides[1]), int(sides[0])


def _positive(text: str) -> float:
    number = float(text)
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return number
