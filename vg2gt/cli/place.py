"""``vg2gt place``: says how large a scene is, or where it is on the Earth, from points in it (docs/guides/view.md)."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vg2gt.cli.arguments import flag_parser
from vg2gt.cli.errors import errors_in_one_line

_UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_SCALE = re.compile(rf"(.+)=\s*([\d.eE+-]+)\s*({'|'.join(_UNITS)})")


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors are reported in one line."""
    parser = flag_parser("place")
    add = parser.add_argument
    add("scene", type=Path, metavar="DIR", help="a folder that vg2gt reconstruct has written")
    how = parser.add_mutually_exclusive_group(required=True).add_argument
    how("--scale", type=_scale, metavar="A,B=1.2m", help="two points of the scene, as the page's Measure shows "
        f"them, and their distance in {', '.join(_UNITS)}")  # fmt: skip
    how("--control", type=Path, metavar="FILE", help="control points: OpenDroneMap's gcp_list.txt, or a CSV with lines "
        "x,y,z,latitude,longitude,altitude for each point, in the scene's frame, degrees and metres")  # fmt: skip
    with errors_in_one_line():
        words = list(sys.argv[1:] if argv is None else argv)
        if "--scale" in words[:-1]:  # argparse takes a point that begins with a minus for an option
            place = words.index("--scale")
            words[place : place + 2] = [f"--scale={words[place + 1]}"]
        run(parser.parse_args(words))


def run(arguments: argparse.Namespace) -> None:
    """Changes ``cameras.json`` and ``report.json``; the Gaussians stay as they are."""
    import numpy as np

    from vg2gt.inputs.control_points import fit_control_points, place_of_csv, read_control_points
    from vg2gt.io import read_cameras_json, write_cameras_json
    from vg2gt.io.files import read_json, write_json
    from vg2gt.reconstruction.frame import SceneFrame, place_figures

    cameras, report = (arguments.scene / name for name in ("cameras.json", "report.json"))
    named, figures = read_cameras_json(cameras), read_json(report) if report.is_file() else {}
    metres, said = arguments.scale, ""
    if arguments.control is not None:
        if arguments.control.suffix.lower() == ".csv":
            place = place_of_csv(arguments.control)
            figures.pop("control_points", None)
        else:
            place, off = fit_control_points(read_control_points(arguments.control), named, arguments.scene)
            figures["control_points"] = off
        metres, said = place.scale, f"; control points are off by {place.error:.3g} m (median)"
        figures |= place_figures(SceneFrame("given", np.eye(4), place=place))
    elif "gps" in figures and abs(figures["metres_per_unit"] / metres - 1) > 0.01:
        del figures["gps"]  # its transform has another scale
        said = "; the place by GPS, which has another scale, is removed"
    write_json(report, figures | {"metres_per_unit": metres})
    write_cameras_json(cameras, [replace(camera, metres_per_unit=metres) for camera in named])
    print(f"a unit of {arguments.scene} is {metres:.4g} m{said}")


def _scale(text: str) -> float:
    """Returns the metres per unit that two points and their distance give."""
    found = _SCALE.fullmatch(text.strip())
    try:
        values = [float(part) for part in found[1].split(",")] if found else []
        length = float(found[2]) * _UNITS[found[3]] if found else 0.0
    except ValueError:
        values, length = [], 0.0
    if len(values) != 6 or not all(map(math.isfinite, [*values, length])) or length <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not two points and a distance, such as 0,0,1,0.5,0,1=1.2m")
    distance = math.dist(values[:3], values[3:])
    if not distance > 0:
        raise argparse.ArgumentTypeError("the two points are the same")
    return length / distance
