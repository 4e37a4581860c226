"""Whether given cameras fit their images: matched features must lie where the cameras see one point."""

from __future__ import annotations

import importlib.util
import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.base import DataError
from vg2gt.data.transforms import reduce_to_fit, to_bytes
from vg2gt.inputs.pair_evidence import Matches
from vg2gt.inputs.pictures import Picture, spread
from vg2gt.inputs.sfm import find_features, match_features
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.colmap import PIXEL_CENTER, quiet_colmap
from vg2gt.io.errors import some
from vg2gt.monitor import Monitor

log = logging.getLogger(__name__)

_GROUPS = 5  # neighbours in the given order that are looked at, evenly spread
_SIDE, _FEATURES = 640, 2000  # longer side of the images in pixels, and their features
_FEWEST = 30  # verified matches of a pair
_PAIRS = 3  # pairs that tell something
_WITHIN = 0.02  # of the longer side: between a feature and the ray of its match
_PARALLEL = 0.3  # degrees between rays, below which the sign of the depth is noise
_FITTING = 0.5  # share of a pair's matches that fit, below which the pair contradicts the cameras
_CONTRADICTED = 0.5  # share of the pairs that contradict the cameras, from which they are wrong altogether
_LOOKED_AT, _SMALL = 20, 320  # neighbours whose points are looked at, and the longer side of their images in pixels
_COMMON = 30  # points of an image that others of these see, too
_ALIKE = 0.5  # median correlation of their brightness, .92 and more in right models, below which images are others
_ODD, _JUMP = 2, 3.0  # most images out of line that are looked at too, and how far out of line, in steps past them
_FOCAL = np.geomspace(1 / 1.6, 1.6, 21)  # times the given focal length that are tried
_CENTER = np.linspace(-0.2, 0.2, 21)  # shifts of the principal point that are tried, of width or height
_NEAR = 0.0015  # of the longer side: median distance of matches up to which the given lens fits
_BETTER = 0.5  # share of that distance, below which another lens is better
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class CheckedView:
    """Camera of an image: intrinsics ``[3, 3]`` at its ``(height, width)``, and ``world_to_camera [4, 4]``."""

    intrinsics: NDArray[np.float64]
    pose: NDArray[np.float64]
    size: tuple[int, int]


_INVERSE = "camera-to-world instead of world-to-camera, or the reverse"
_BOTH = f"{_INVERSE}, and in the other of OpenGL's and OpenCV's axes"
_READINGS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    _INVERSE: invert_pose,
    "in OpenGL axes instead of OpenCV's, or the reverse": lambda pose: _FLIP @ pose,
    _BOTH: lambda pose: invert_pose(pose @ _FLIP),
}


def check_cameras(pictures: Sequence[Picture], monitor: Monitor, insisted: bool = False) -> None:
    """Checks given cameras by matched features of 10 to 16 images, if pycolmap is installed.

    A match fits if the cameras see one point in front of both within 2 % of the longer side. The points of a sparse
    model are such matches; its images are checked to be those that it was made of.

    Args:
        pictures: pictures with given cameras.
        monitor: shows the stage.
        insisted: only warn, because these cameras were asked for.

    Raises:
        DataError: if at least half of the pairs of images contradict the cameras; fewer are a warning.
    """
    _check_points([each for each in pictures if each.points is not None], insisted)
    known = [each for each in pictures if each.pose is not None and each.points is None]
    if len(known) < len(pictures) or len(known) < 2 or importlib.util.find_spec("pycolmap") is None:
        return
    chosen = _neighbours(known, _GROUPS, _out_of_line(known))
    with monitor.stage("check cameras"):
        matches, views = match_pictures(chosen)
    shares = _fitting_shares(matches, views)
    if better := better_lens(matches, views):
        log.warning(
            "the images fit the cameras of %s better with %s: check it, or find the cameras from the images by "
            "--poses sfm", pictures[0].source, better,
        )  # fmt: skip
    titles = {name: each.name for name, each in _numbered(chosen)}
    against = [f"{titles[one]} and {titles[other]}" for (one, other), share in shares.items() if share < _FITTING]
    if not against or len(shares) < min(_PAIRS, len(chosen) - 1):
        return
    said = (
        f"the cameras of {pictures[0].source} contradict the images: in {len(against)} of {len(shares)} pairs of "
        f"images, most matched features are not where the cameras see one point ({some(against, 3)})"
    )
    if len(against) < _CONTRADICTED * len(shares):
        log.warning("%s; some cameras may be wrong, or the images show things that look alike or move", said)
        return
    _refuse(f"{said}. {_advice(matches, views, pictures[0].source.startswith('Nerfstudio'))}", insisted)


def _refuse(said: str, insisted: bool) -> None:
    if not insisted:
        raise DataError(f"{said}; --poses sfm finds the cameras from the images, --poses given takes these as they are")
    log.warning("%s; they are used as they are", said)


def _neighbours(pictures: Sequence[Picture], count: int, odd: Sequence[int] = ()) -> list[Picture]:
    """Returns up to ``count`` pairs of neighbours, evenly spread, and the images ``odd`` with theirs."""
    starts = spread(len(pictures) - 1, min(count, len(pictures) - 1))
    places = {place + step for place in starts for step in range(2)}
    places |= {place + step for place in odd for step in (-1, 0, 1)}
    return [pictures[place] for place in sorted(places)]


def _out_of_line(pictures: Sequence[Picture]) -> list[int]:
    """Returns the images that are farthest from their neighbours, in place or direction, if these are near each other.

    A wrong camera among right ones is so; whether it is wrong, its matches tell.
    """
    poses = np.stack([each.pose for each in pictures if each.pose is not None])
    found = np.zeros(len(poses))
    for values in (-np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]), poses[:, :3, :3].reshape(-1, 9)):
        step, past = (np.linalg.norm(values[n:] - values[:-n], axis=1) for n in (1, 2))
        floor = max(float(np.median(step)), np.finfo(float).tiny)
        found[1:-1] = np.maximum(found[1:-1], np.minimum(step[1:], step[:-1]) / np.maximum(past, floor))
    return [place for place in np.argsort(-found)[:_ODD].tolist() if found[place] > _JUMP]


def _check_points(pictures: Sequence[Picture], insisted: bool) -> None:
    """Checks that points of a sparse model look alike in the images that see them, as they do in its own images."""
    if len(pictures) < _PAIRS:
        return
    seen = [_brightness(each) for each in _neighbours(pictures, _LOOKED_AT)]
    points, rows = np.unique(np.concatenate([numbers for numbers, _ in seen]), return_inverse=True)
    total, count = (np.bincount(rows, w, len(points)) for w in (np.concatenate([values for _, values in seen]), None))
    found, start = [], 0
    for _, values in seen:
        own, start = rows[start : start + len(values)], start + len(values)
        common = count[own] > 1
        others = (total[own] - values)[common] / (count[own][common] - 1)
        if len(others) >= _COMMON and min(others.std(), values[common].std()) > 0:
            found.append(float(np.corrcoef(others, values[common])[0, 1]))
    if len(found) >= _PAIRS and np.median(found) < _ALIKE:
        _refuse(
            f"the images are not those that {pictures[0].source} was made of: its points look different in each of "
            "them. Were they renamed, turned, or taken from the video again",
            insisted,
        )


def _brightness(picture: Picture) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the numbers ``[n]`` of the points that a picture sees, and their brightness."""
    assert picture.points is not None
    scale = min(1.0, _SMALL / max(picture.size))
    target = (max(1, round(picture.size[0] * scale)), max(1, round(picture.size[1] * scale)))
    grey = reduce_to_fit(picture.read(target), (_SMALL, _SMALL)).images[0].mean(0).double().numpy()
    columns, rows = (picture.points.places * grey.shape[::-1]).astype(int).T
    return picture.points.numbers, grey[rows, columns]


def _advice(matches: Matches, views: dict[str, CheckedView], is_opengl: bool) -> str:
    """Says what is wrong with contradicted cameras, in the axes of their file."""
    for reading, change in _READINGS.items():
        changed = {name: replace(view, pose=change(view.pose)) for name, view in views.items()}
        if min(_fitting_shares(matches, changed).values()) >= _FITTING:
            swapped = {_INVERSE: _BOTH, _BOTH: _INVERSE} if is_opengl else {}
            return f"They fit if the poses are {swapped.get(reading, reading)}: correct them"
    return "Check their order, axes and focal length"


def match_pictures(pictures: Sequence[Picture]) -> tuple[Matches, dict[str, CheckedView]]:
    """Returns matched features of pictures, and their cameras by the names there."""
    with tempfile.TemporaryDirectory(prefix="vg2gt-check-") as temporary, quiet_colmap():
        folder, silent = Path(temporary), Monitor()
        (folder / "images").mkdir()
        views = {name: _staged(each, folder / "images" / name) for name, each in _numbered(pictures)}
        lenses: dict[tuple[int, int, float], list[str]] = {}
        for name, view in views.items():
            lenses.setdefault((*view.size, 0.0), []).append(name)
        find_features(folder, lenses, sorted(views), (_SIDE, _FEATURES, 0), silent)
        match_features(folder, sorted(views), silent)
        return Matches.read(folder / "database.db"), views


def _numbered(pictures: Sequence[Picture]) -> list[tuple[str, Picture]]:
    return [(f"{number:06d}.jpg", picture) for number, picture in enumerate(pictures)]


def _staged(picture: Picture, file: Path) -> CheckedView:
    """Writes a reduced picture and returns its camera."""
    assert picture.pose is not None
    scale = min(1.0, _SIDE / max(picture.size))
    target = (round(picture.size[0] * scale), round(picture.size[1] * scale))
    frames = reduce_to_fit(picture.read(target), (_SIDE, _SIDE))
    pixels = to_bytes(frames.images[0]).permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(file, quality=95)
    return CheckedView(frames.intrinsics[0].double().numpy(), picture.pose, (pixels.shape[0], pixels.shape[1]))


def _fitting_shares(matches: Matches, views: dict[str, CheckedView]) -> dict[tuple[str, str], float]:
    """Returns the share of matches that fit the cameras, of every image's pair with most matches."""
    return {pair: float((off < _WITHIN).mean()) for pair, off in _distances(matches, views).items()}


def better_lens(matches: Matches, views: dict[str, CheckedView]) -> str:
    """Says which other focal length or principal point makes matches fit much better; empty if the given ones fit."""

    def _distance(scale: Sequence[float] = (1, 1), shift: Sequence[float] = (0, 0)) -> float:
        change = np.diag([*scale, 1.0])
        moved = {}
        for name, view in views.items():
            matrix = change @ view.intrinsics
            matrix[:2, 2] = view.intrinsics[:2, 2] + np.array(shift) * view.size[::-1]
            moved[name] = replace(view, intrinsics=matrix)
        found = list(_distances(matches, moved).values())
        return float(np.median(np.minimum(np.concatenate(found), _WITHIN))) if found else 0.0

    if (given := _distance()) <= _NEAR:
        return ""
    tried = [(_distance((f, f)), f"a focal length of about {f:.2f} times the given one") for f in _FOCAL]
    tried += [(_distance((1, f)), f"a vertical focal length of about {f:.2f} times the given one") for f in _FOCAL]
    for kind, axis in (("width", (1, 0)), ("height", (0, 1))):
        said = f"a principal point moved by about {{:+.0%}} of the {kind}"
        tried += [(_distance(shift=share * np.array(axis)), said.format(share)) for share in _CENTER]
    least, best = min(tried)
    return best if least < _BETTER * given else ""


def _distances(matches: Matches, views: dict[str, CheckedView]) -> dict[tuple[str, str], NDArray[np.float64]]:
    """Returns how far matches ``[m]`` are from where the cameras see one point, of every image's strongest pair."""
    strongest: dict[str, tuple[str, str]] = {}
    for pair, rows in matches.pairs.items():
        for name in pair if len(rows) >= _FEWEST else ():
            if name not in strongest or len(rows) > len(matches.pairs[strongest[name]]):
                strongest[name] = pair
    found = {}
    for pair in sorted(set(strongest.values())):
        rows = matches.pairs[pair]
        pixels = [matches.features[name][rows[:, side]] - PIXEL_CENTER for side, name in enumerate(pair)]
        found[pair] = _distance(pixels, [views[name] for name in pair])
    return found


def _distance(pixels: Sequence[NDArray[np.float64]], views: Sequence[CheckedView]) -> NDArray[np.float64]:
    """Returns how far matches ``[m]`` are from one point, as a share of the longer side; inf if it is not in front."""
    rays, centers = [], []
    for points, view in zip(pixels, views, strict=True):
        turn = view.pose[:3, :3]
        own = np.concatenate([points, np.ones((len(points), 1))], 1) @ np.linalg.inv(view.intrinsics).T @ turn
        rays.append(own / np.linalg.norm(own, axis=1, keepdims=True))
        centers.append(-turn.T @ view.pose[:3, 3])
    cosine = (rays[0] * rays[1]).sum(1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    base = centers[1] - centers[0]
    along = [rays[0] @ base, -(rays[1] @ base)]
    # distances along both rays to where they are closest
    depths = [(along[0] + cosine * along[1]) / sine2, (along[1] + cosine * along[0]) / sine2]
    far = 1e6 * (np.linalg.norm(base) or 1.0)  # any distance will do for cameras in one place, as on a tripod
    parallel = sine2 < np.sin(np.radians(_PARALLEL)) ** 2
    found = np.zeros(len(cosine))
    for one, other in ((0, 1), (1, 0)):
        points = centers[one] + np.where(parallel, far, depths[one])[:, None] * rays[one]
        local = points @ views[other].pose[:3, :3].T + views[other].pose[:3, 3]
        shown = local @ views[other].intrinsics.T
        with np.errstate(divide="ignore", invalid="ignore"):  # beside or in the camera: does not fit
            error = np.linalg.norm(shown[:, :2] / shown[:, 2:] - pixels[other], axis=1)
        in_front = (local[:, 2] > 0) & (parallel | (depths[one] > 0))
        found = np.maximum(found, np.where(in_front, error / max(views[other].size), np.inf))
    return found
