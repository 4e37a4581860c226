"""Scale and place by GPS, one half of the photographs against the other: ``python benchmarks/gps.py SCENE PHOTOS``.

SCENE is a folder that ``vg2gt reconstruct`` wrote for the photographs in PHOTOS, which have GPS positions in EXIF; its
cameras are from structure from motion over all of them. Each half alone gives a scale, a place and up, as the command
finds them. The halves are every other photograph, the first and the second half, and 200 random ones. Prints a table
and writes a dated JSON file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import parser, write_results
from numpy.typing import NDArray

from vg2gt import __version__
from vg2gt.geometry.geodesy import Place, enu, fit_place
from vg2gt.io.cameras_json import invert_pose, read_cameras_json
from vg2gt.io.image_files import gps_position

RANDOM_HALVES = 200


def positions(place: Place, centers: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns metres ``[N, 3]`` east, north and up of an origin of cameras ``[N, 3]``, by a place."""
    own = centers @ place.to_enu[:3, :3].T + place.to_enu[:3, 3]
    return own + enu(np.array([place.origin]), origin)


def compare(
    centers: NDArray[np.float64], measured: NDArray[np.float64], half: NDArray[np.bool_]
) -> dict[str, float] | None:
    """Compares two halves of the photographs.

    Args:
        centers: ``[N, 3]`` camera centres in the scene's world.
        measured: ``[N, 3]`` latitude, longitude and altitude.
        half: ``[N]`` the photographs of the first half.

    Returns:
        ``scale``: relative difference of the scales; ``up``: angle between the directions up in degrees; ``error`` and
        ``altitude``: median distance and median difference of altitude in metres of the cameras of each half, placed
        by the other. None if a half gives no place.
    """
    places = [fit_place(centers[part], measured[part]) for part in (half, ~half)]
    if places[0] is None or places[1] is None:
        return None
    origin = np.median(measured, 0)
    off = np.concatenate(
        [
            (positions(place, centers, origin) - enu(measured, origin))[part]
            for place, part in zip((places[0], places[1]), (~half, half), strict=True)
        ]
    )
    angle = float(np.degrees(np.arccos(np.clip(places[0].up @ places[1].up, -1, 1))))
    return {
        "scale": abs(places[0].scale / places[1].scale - 1),
        "up": angle,
        "error": float(np.median(np.linalg.norm(off, axis=1))),
        "altitude": float(np.median(np.abs(off[:, 2]))),
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the comparison."""
    arguments = parser(__doc__)
    arguments.add_argument("scene", type=Path)
    arguments.add_argument("photos", type=Path)
    options = arguments.parse_args(argv)
    cameras = read_cameras_json(options.scene / "cameras.json")
    found = {path.name: gps_position(path) for path in sorted(options.photos.iterdir())}
    known = {name: each for name, each in found.items() if each is not None and np.isfinite(each).all()}
    named = [(camera, known.get((camera.photo or camera).name)) for camera in cameras]
    centers = np.array([invert_pose(camera.world_to_camera)[:3, 3] for camera, position in named if position])
    measured = np.array([position for _, position in named if position])
    count = len(centers)
    if count < 8:
        raise SystemExit(f"{count} cameras of {options.scene} have a GPS position in {options.photos}; 8 are needed")
    rng, numbers = np.random.default_rng(0), np.arange(count)
    rows = {"every other": compare(centers, measured, numbers % 2 == 0)}
    rows["first and second"] = compare(centers, measured, numbers < count // 2)
    random = [compare(centers, measured, rng.permutation(count) < count // 2) for _ in range(RANDOM_HALVES)]
    placed = [each for each in random if each is not None]
    for name, share in (("random, median", 0.5), ("random, 95 %", 0.95), ("random, largest", 1.0)):
        rows[name] = {key: float(np.quantile([each[key] for each in placed], share)) for key in placed[0]}
    print(f"{count} photographs; {len(placed)} of {RANDOM_HALVES} random halves give a place")
    for name, row in rows.items():
        if row is not None:
            off = f"off by {row['error']:.2f} m, altitude {row['altitude']:.2f} m"
            print(f"{name:17} scale {100 * row['scale']:.2f} %, up {row['up']:.2f} degrees, {off}")
    figures = {"version": __version__, "photographs": count, "halves_placed": len(placed), "rows": rows}
    write_results(options.out, "gps", figures)


if __name__ == "__main__":
    main()
