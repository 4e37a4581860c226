"""Finds structure that folds onto itself: images of equal sides of an object that were taken for one side.

Matches cannot tell equal sides apart, and a model that puts them on top of each other has small errors. What surrounds
them can: two images taken from one place show the same everywhere. If points that one image shows are missing in
another one from nearly the same position, where that one shows points of its own, the two see different places (compare
missing correspondences, Zach et al. 2008, and conflicting observations, Heinly et al. 2014). The matches of such pairs
are removed. Where nothing surrounds the sides, images whose matches contradict the model are what can be found.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

_NEAR = 25.0  # degrees between two images' lines of sight to the same points, below which they must show the same
_CELLS = 10  # along the longer side of an image
_FEWEST = 4  # points of either image in a cell that is compared
_EXPECTED = 3.0  # common points of a compared cell, if both images show the same
_COMPARED = 8  # minimum number of compared cells
_DIFFERENT, _ALIKE = 0.1, 0.02  # share of the compared cells without a common point: of different places, of the same
_LEAST_ANGLE, _FITTING = 1.5, 0.006  # degrees between the rays of a match, its error as a share of the longer side
_SHARED = 0.02  # of the longer side: between a feature and where another match places it
_STRONG = 30  # matches of a pair that must be in the model
_EXPLAINED = 0.2  # of a pair's matches, below which the model contradicts it
_RIVAL = 0.2  # of an image's best matched pair, from which a contradicted pair counts
_OUTVOTED = 2  # images that tell a pair apart, beyond twice those that do not, though it looks alike itself
_RARE = 0.3  # of an image's matched features: those that are matched in the fewest other images
_FOUND = 2  # matches in a cell that a pair covers
_COVERED = 0.5  # of the cells that the best pair of either image covers: the first models are made of such pairs
_MOST = 0.5  # of a pair's matches, that must fit the cameras
_FEWEST_FALSE = 3  # pairs of different places, below which nothing is removed
_MISLED = 0.5  # different pairs per pair that looks alike, below which nothing is removed
_FEWEST_UNDECIDED = 0.1  # of the placed images, and at least three of them
_ROUNDS = 3  # models of pairs that cover most, until none differs


@dataclass(frozen=True)
class Matches:
    """Matches of all compared pairs of images, as indices of features ``[m, 2]`` by names in sorted order.

    Attributes:
        sizes: width and height of every image in pixels.
        features: positions ``[n, 2]`` of every image's features, in COLMAP's pixels.
        pairs: verified matches.
        raw: all matches of the same pairs: where most are on one plane, only those are verified.
    """

    sizes: dict[str, tuple[int, int]]
    features: dict[str, NDArray[np.float64]]
    pairs: dict[tuple[str, str], NDArray[np.int64]]
    raw: dict[tuple[str, str], NDArray[np.int64]]

    @staticmethod
    def read(database: Path) -> Matches:
        """Reads COLMAP's database."""
        import pycolmap  # pyright: ignore[reportMissingImports]

        with closing(pycolmap.Database.open(database)) as opened:
            images = opened.read_all_images()
            names = {image.image_id: image.name for image in images}
            cameras = {camera.camera_id: (camera.width, camera.height) for camera in opened.read_all_cameras()}
            sizes = {image.name: cameras[image.camera_id] for image in images}
            features = {name: np.array(opened.read_keypoints(key)[:, :2], float) for key, name in names.items()}
            raw = dict(zip(*opened.read_all_matches(), strict=True))
            keys, geometries = opened.read_two_view_geometries()
        verified = {key: geometry.inlier_matches for key, geometry in zip(keys, geometries, strict=True)}
        tables: list[dict[tuple[str, str], NDArray[np.int64]]] = [{}, {}]
        for table, found in zip(tables, (verified, raw), strict=True):
            for key, part in found.items():
                one, other = (names[number] for number in pycolmap.pair_id_to_image_pair(key))
                rows = np.asarray(part, np.int64).reshape(-1, 2)
                if len(rows):
                    table[min(one, other), max(one, other)] = rows if one < other else rows[:, ::-1]
        return Matches(sizes, features, *tables)

    def without(self, removed: Set[tuple[str, str]]) -> Matches:
        """Returns the matches; those of removed pairs are not verified."""
        return replace(self, pairs={pair: rows for pair, rows in self.pairs.items() if pair not in removed})


class _Seen:
    """What the placed images of a model see: features that matches of two or more images place.

    Matches of a pair count if they fit the two cameras, also if the model has no point of them.
    """

    def __init__(self, model: Reconstruction, matches: Matches) -> None:
        self.images = {image.name: image for image in model.images.values() if image.has_pose}
        self.poses = {name: image.cam_from_world().matrix() for name, image in self.images.items()}
        self.owner = {
            name: np.array([point.point3D_id if point.has_point3D() else -1 for point in image.points2D], np.int64)
            for name, image in self.images.items()
        }
        self.points = {key: point.xyz for key, point in model.points3D.items()}
        self.sizes = {name: np.array(size) for name, size in matches.sizes.items()}
        self._features, self._raw = matches.features, matches.raw
        self._rays = {}
        for name, image in self.images.items():
            rays = image.camera.cam_from_img(np.ascontiguousarray(matches.features[name]))
            rays = np.concatenate([rays, np.ones((len(rays), 1))], 1) @ self.poses[name][:, :3]
            self._rays[name] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        self.pairs = {pair for pair in matches.raw if pair[0] in self.images and pair[1] in self.images}
        places: dict[str, list[NDArray[np.float64]]] = {name: [] for name in self.images}
        for pair in sorted(self.pairs):
            rows = matches.raw[pair]
            found, along = self._placed(pair, rows)
            fits = np.isfinite(found).all(1)
            for side, name in enumerate(pair):
                columns = rows[:, side, None].astype(float), along[:, None], found
                places[name].append(np.concatenate(columns, 1)[fits])
        self.rows: dict[str, NDArray[np.int64]] = {}
        self.places: dict[str, NDArray[np.float64]] = {}
        for name, parts in places.items():
            joined = np.concatenate([np.zeros((0, 5)), *parts])
            joined = joined[np.argsort(joined[:, 1], kind="stable")]  # the largest angle between rays first
            rows, first = np.unique(joined[:, 0].astype(np.int64), return_index=True)
            self.rows[name], self.places[name] = rows, joined[first, 2:]

    def _placed(
        self, pair: tuple[str, str], rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the positions ``[m, 3]`` of matches, NaN where they do not fit the cameras, and the rays' cosine."""
        rays = [self._rays[name][rows[:, side]] for side, name in enumerate(pair)]
        centers = [_center(self.poses[name]) for name in pair]
        apart = centers[1] - centers[0]
        along = (rays[0] * rays[1]).sum(1)
        with np.errstate(all="ignore"):
            scale = 1 / (1 - along**2)
            depths = [
                ((rays[0] @ apart) - along * (rays[1] @ apart)) * scale,
                (along * (rays[0] @ apart) - (rays[1] @ apart)) * scale,
            ]
            place = (centers[0] + depths[0][:, None] * rays[0] + centers[1] + depths[1][:, None] * rays[1]) / 2
        fits = (depths[0] > 0) & (depths[1] > 0) & (along < np.cos(np.radians(_LEAST_ANGLE)))
        for side, name in enumerate(pair):
            pixels, ahead = self._pixels(name, self.poses[name], place)
            far = np.linalg.norm(pixels - self._features[name][rows[:, side]], axis=1)
            fits &= ahead & (far < _FITTING * self.sizes[name].max())
        return np.where(fits[:, None], place, np.nan), along

    def _pixels(
        self, name: str, pose: NDArray[np.float64], places: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Returns the pixels ``[n, 2]`` of positions in an image, and whether they are in front of its camera."""
        with np.errstate(invalid="ignore"):
            inside = places @ pose[:, :3].T + pose[:, 3]
        ahead = np.isfinite(inside).all(1) & (inside[:, 2] > 1e-6)
        pixels = np.full((len(places), 2), np.nan)
        if ahead.any():
            pixels[ahead] = self.images[name].camera.img_from_cam(np.ascontiguousarray(inside[ahead]))
        return pixels, ahead

    def explained(self, pair: tuple[str, str], rows: NDArray[np.int64]) -> float:
        """Returns the share of a pair's matches that are points of the model; 0 if an image has no camera."""
        if not (pair[0] in self.images and pair[1] in self.images):
            return 0.0
        owners = self.owner[pair[0]][rows[:, 0]], self.owner[pair[1]][rows[:, 1]]
        return float(((owners[0] == owners[1]) & (owners[0] >= 0)).mean())

    def fit(self, pair: tuple[str, str], rows: NDArray[np.int64]) -> float:
        """Returns the share of a pair's features at points of the model that are where their matches are.

        0 if they are few. Two rays of a false match may meet, but the point is where the other feature is not.
        """
        good: list[NDArray[np.bool_]] = []
        for side, name in enumerate(pair):
            other = pair[1 - side]
            owner = self.owner[name][rows[:, side]]
            places = np.array([self.points[key] for key in owner[owner >= 0]]).reshape(-1, 3)
            pixels, _ = self._pixels(other, self.poses[other], places)
            far = np.linalg.norm(pixels - self._features[other][rows[owner >= 0, 1 - side]], axis=1)
            good.append(far < _SHARED * self.sizes[other].max())
        joined = np.concatenate(good)
        return float(joined.mean()) if len(joined) >= _STRONG else 0.0

    def different(self, pair: tuple[str, str], rows: NDArray[np.int64]) -> float | None:
        """Returns the share of near images that shows something else in the one than in the other; None: unknown.

        Where the model does not explain their matches, the images are compared as if the matches were right.
        """
        as_placed = self.explained(pair, rows) >= _EXPLAINED
        shares = [self._missing(pair, rows, side, as_placed) for side in range(2)]
        known = [share for share in shares if share is not None]
        return min(known) if len(known) == 2 else None

    def _missing(self, pair: tuple[str, str], rows: NDArray[np.int64], side: int, as_placed: bool) -> float | None:
        """Returns the share of the cells of one image that show nothing that the other one shows there."""
        one, other = pair[side], pair[1 - side]
        partner = np.full(len(self._features[one]), -1)
        partner[self._raw[pair][:, side]] = self._raw[pair][:, 1 - side]
        places, partner = self.places[one], partner[self.rows[one]]
        pose = self.poses[other] if as_placed else self._pose_by(other, places, partner)
        if pose is None:
            return None
        sights = [places - _center(each) for each in (self.poses[one], pose)]
        lengths = [np.linalg.norm(sight, axis=1) for sight in sights]
        cosine = (sights[0] * sights[1]).sum(1) / np.maximum(lengths[0] * lengths[1], 1e-12)
        ratio = lengths[0] / np.maximum(lengths[1], 1e-12)
        size = self.sizes[other]
        pixels, ahead = self._pixels(other, pose, places)
        with np.errstate(invalid="ignore"):
            visible = ahead & (pixels >= 0).all(1) & (pixels < size).all(1)
        near = visible & (cosine > np.cos(np.radians(_NEAR))) & (ratio > 1 / 1.5) & (ratio < 1.5)
        apart = np.linalg.norm(pixels - self._features[other][partner], axis=1)
        with np.errstate(invalid="ignore"):
            shared = (partner >= 0) & (apart < _SHARED * size.max())
        expected = count_cells(pixels[near], size)
        theirs = count_cells(self._features[other][self.rows[other]], size)
        common = count_cells(pixels[near & shared], size)
        alike = common > 0
        if alike.sum() < _FEWEST:
            return None
        rate = common[alike].sum() / expected[alike].sum()  # of features found again where both show the same
        compared = (expected >= max(_FEWEST, _EXPECTED / rate)) & (theirs >= _FEWEST)
        if compared.sum() < _COMPARED:
            return None
        return float((common[compared] == 0).mean())

    def _pose_by(
        self, name: str, places: NDArray[np.float64], partner: NDArray[np.int64]
    ) -> NDArray[np.float64] | None:
        """Returns the pose ``[3, 4]`` of an image by matches of its features with known positions."""
        import pycolmap  # pyright: ignore[reportMissingImports]

        known = partner >= 0
        if known.sum() < _STRONG:
            return None
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.random_seed = 0
        found = pycolmap.estimate_and_refine_absolute_pose(
            self._features[name][partner[known]], places[known], self.images[name].camera, options
        )
        return None if found is None else found["cam_from_world"].matrix()


def _center(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return -pose[:, :3].T @ pose[:, 3]


def count_cells(pixels: NDArray[np.float64], size: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the number of pixels ``[n, 2]`` in each of 10 x 10 square cells ``[100]`` of an image of (width, height).

    Ten cells are as long as the longer side, so that some remain empty in an image that is not square.
    """
    cells = np.clip((pixels / (max(size) / _CELLS)).astype(int), 0, _CELLS - 1)
    return np.bincount(cells[:, 1] * _CELLS + cells[:, 0], minlength=_CELLS * _CELLS)


def _verdicts(models: Sequence[Reconstruction], matches: Matches) -> dict[tuple[str, str], bool]:
    """Returns which pairs of images, of those that the models put near each other, show the same place."""
    verdict: dict[tuple[str, str], bool] = {}
    for model in models:
        seen = _Seen(model, matches)
        for pair in seen.pairs & matches.pairs.keys():
            share = seen.different(pair, matches.pairs[pair])
            if share is not None and (share >= _DIFFERENT or share <= _ALIKE):
                verdict[pair] = share <= _ALIKE
    return verdict


def _is_folded(verdict: Mapping[tuple[str, str], bool]) -> bool:
    """Returns whether so many pairs show different places that a model may be folded.

    As many differ as look alike around an object of two equal sides, three times as many or more with more of them.
    Where all is right, a third as many do in a kitchen, a tenth around a tree.
    """
    differ = sum(not alike for alike in verdict.values())
    return differ >= max(_FEWEST_FALSE, _MISLED * (len(verdict) - differ))


def _differing(models: Sequence[Reconstruction], matches: Matches) -> set[tuple[str, str]]:
    """Returns the pairs of images that show different places, though the models are made of their matches."""
    views = [_Seen(model, matches) for model in models]
    return {
        pair
        for pair, alike in _verdicts(models, matches).items()
        if not alike and any(seen.explained(pair, matches.pairs[pair]) >= _EXPLAINED for seen in views)
    }


def _doubtful(verdict: Mapping[tuple[str, str], bool], matches: Matches) -> set[tuple[str, str]]:
    """Returns the pairs of images whose matches may be of equal sides of different places.

    Of the images that show the same as one of a pair, more may not differ from the other one than agree.
    """
    found = {pair for pair, alike in verdict.items() if not alike}
    same: dict[str, set[str]] = {name: set() for name in matches.features}
    other: dict[str, set[str]] = {name: set() for name in matches.features}
    for (one, two), alike in verdict.items():
        for first, second in ((one, two), (two, one)):
            (same if alike else other)[first].add(second)
    for one, two in matches.pairs:
        agree = len(same[one] & same[two])
        against = len(same[one] & other[two]) + len(other[one] & same[two])
        if against >= (2 * agree + _OUTVOTED if verdict.get((one, two)) else agree + 1):
            found.add((one, two))
    return found


def _covering(matches: Matches) -> set[tuple[str, str]]:
    """Returns the pairs of images that share what few others have, everywhere where one of them has it.

    Equal sides are in many images, what surrounds them in neighbours only.
    """
    counts = {name: np.zeros(len(found), int) for name, found in matches.features.items()}
    for pair, rows in matches.pairs.items():
        for side, name in enumerate(pair):
            counts[name][np.unique(rows[:, side])] += 1
    rare = {
        name: (count > 0) & (count <= np.quantile(count[count > 0], _RARE))
        for name, count in counts.items()
        if count.any()
    }

    def cells(name: str, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        return count_cells(matches.features[name][rows], matches.sizes[name])

    known = {name: cells(name, np.flatnonzero(chosen)) >= _FEWEST for name, chosen in rare.items()}
    covered = {
        pair: min(
            (known[name] & (cells(name, rows[rare[name][rows[:, side]], side]) >= _FOUND)).sum()
            / max(known[name].sum(), 1)
            for side, name in enumerate(pair)
        )
        for pair, rows in matches.pairs.items()
    }
    best: dict[str, float] = {}
    for pair, share in covered.items():
        for name in pair:
            best[name] = max(best.get(name, 0.0), share)
    return {pair for pair, share in covered.items() if share >= _COVERED * min(best[name] for name in pair)}


def _fitting(
    models: Sequence[Reconstruction], matches: Matches, otherwise: set[tuple[str, str]]
) -> set[tuple[str, str]]:
    """Returns the pairs whose matches fit the cameras of the first model that has both; else those of ``otherwise``."""
    fit: dict[tuple[str, str], bool] = {}
    for model in models:
        seen = _Seen(model, matches)
        for pair in seen.pairs & (matches.pairs.keys() - fit.keys()):
            fit[pair] = seen.fit(pair, matches.pairs[pair]) > _MOST
    return {pair for pair in matches.pairs if fit.get(pair, pair in otherwise)}


def _remove(database: Path, pairs: Set[tuple[str, str]]) -> None:
    """Removes the matches of pairs from COLMAP's database."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    with closing(pycolmap.Database.open(database)) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for one, other in pairs:
            if opened.exists_matches(numbers[one], numbers[other]):
                opened.delete_matches(numbers[one], numbers[other])
            if opened.exists_two_view_geometry(numbers[one], numbers[other]):
                opened.delete_two_view_geometry(numbers[one], numbers[other])


def contradicted_images(models: Sequence[Reconstruction], matches: Matches) -> list[str]:
    """Returns the placed images that fit at two places: many of their matches are not in the first model.

    Args:
        models: models of the images; the first one is used.
        matches: verified matches that count.
    """
    seen = _Seen(models[0], matches)
    best: dict[str, int] = {}
    rivals: dict[str, int] = {}
    for pair, rows in matches.pairs.items():
        against = len(rows) >= _STRONG and seen.explained(pair, rows) < _EXPLAINED
        for name in pair:
            best[name] = max(best.get(name, 0), len(rows))
            rivals[name] = max(rivals.get(name, 0), len(rows) if against else 0)
    return sorted(name for name, count in rivals.items() if name in seen.images and count > _RIVAL * best[name])


def unfold(
    database: Path, matches: Matches, models: list[Reconstruction], again: Callable[[], list[Reconstruction]]
) -> tuple[list[Reconstruction], list[str]]:
    """Returns models without matches of equal sides, and the images of the first model that fit at two places.

    Args:
        database: COLMAP's database; false matches are removed from it.
        matches: its matches.
        models: models made with all matches.
        again: makes the models again.
    """
    verdict = _verdicts(models, matches)
    undecided: set[str] = set()
    if _is_folded(verdict):
        everything, count = database.with_suffix(".all"), len(models[0].images)
        shutil.copyfile(database, everything)

        def models_of(kept: Set[tuple[str, str]]) -> tuple[list[Reconstruction], Matches]:
            shutil.copyfile(everything, database)
            _remove(database, matches.raw.keys() - kept)
            return again() or models, matches.without(matches.pairs.keys() - kept)

        tries: list[tuple[set[str], list[Reconstruction], Matches]] = []
        for excluded in (set[tuple[str, str]](), _doubtful(verdict, matches)):
            kept = _covering(matches.without(excluded))
            found, used = models_of(kept)
            for _ in range(_ROUNDS):
                false = _differing(found, used)
                without = models_of(kept - false) if false else (found, used)
                if not false or (len(false) < _FEWEST_FALSE and len(without[0][0].images) < len(found[0].images)):
                    break  # also where a few that look different are all that links a part of the images
                kept, (found, used) = kept - false, without
            found, used = models_of(_fitting(found, matches, kept))
            false = _differing(found, used)
            named = {name for pair in false for name in pair} if len(false) >= _FEWEST_FALSE else set[str]()
            tries.append((named, found, used))
            if not named and len(found[0].images) >= count:
                break
        undecided, models, used = min(tries, key=lambda each: (len(each[0]), -len(each[1][0].images)))
        removed = matches.without(used.pairs.keys())
        alike = {pair for pair, same in _verdicts(models, removed).items() if same}  # by all that surrounds them
        matches = matches.without(removed.pairs.keys() - alike)
    undecided |= set(contradicted_images(models, matches))
    enough = max(3, _FEWEST_UNDECIDED * len(models[0].images))
    return models, sorted(undecided) if len(undecided) >= enough else []
