"""What surrounds the matches of two images says about them: do both images show the same place?

Matches cannot tell equal sides of an object apart. What surrounds them can: two images taken from one place show the
same everywhere. If points that one image shows are missing in another one from nearly the same position, where that one
shows points of its own, the two see different places (compare missing correspondences, Zach et al. 2008, and
conflicting observations, Heinly et al. 2014).
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

STRONG = 30  # matches of a pair that must be in the model
FEWEST = 4  # points of either image in a cell that is compared
_NEAR = 25.0  # degrees between two images' lines of sight to the same points, below which they must show the same
_CELLS = 10  # along the longer side of an image
_EXPECTED = 3.0  # common points of a compared cell, if both images show the same
_COMPARED = 8  # minimum number of compared cells
_DIFFERENT, _ALIKE = 0.1, 0.02  # share of the compared cells without a common point: of different places, of the same
_LEAST_ANGLE, _FITTING = 1.5, 0.006  # degrees between the rays of a match, its error as a share of the longer side
_SHARED = 0.02  # of the longer side: between a feature and where another match places it
_EXPLAINED = 0.2  # of a pair's matches, below which the model contradicts it
_MOST = 0.5  # of a pair's matches, that must fit the cameras


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


class PairEvidence:
    """What a model says about pairs of images, by the features that the images see and matches place.

    Matches of a pair count if they fit the two cameras, also if the model has no point of them.

    Args:
        model: places some or all images.
        matches: its matches, and those of pairs that it was made without.

    Attributes:
        images: placed images by name.
        pairs: verified pairs of placed images.
    """

    def __init__(self, model: Reconstruction, matches: Matches) -> None:
        self.images = {image.name: image for image in model.images.values() if image.has_pose}
        self._poses = {name: image.cam_from_world().matrix() for name, image in self.images.items()}
        self._owner = {
            name: np.array([point.point3D_id if point.has_point3D() else -1 for point in image.points2D], np.int64)
            for name, image in self.images.items()
        }
        self._points = {key: point.xyz for key, point in model.points3D.items()}
        self._sizes = {name: np.array(size) for name, size in matches.sizes.items()}
        self._matches, self._features = matches, matches.features
        self._rays = {}
        for name, image in self.images.items():
            rays = image.camera.cam_from_img(np.ascontiguousarray(matches.features[name]))
            rays = np.concatenate([rays, np.ones((len(rays), 1))], 1) @ self._poses[name][:, :3]
            self._rays[name] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        self.pairs = {pair for pair in matches.pairs if pair[0] in self.images and pair[1] in self.images}
        places: dict[str, list[NDArray[np.float64]]] = {name: [] for name in self.images}
        for pair, rows in sorted(matches.raw.items()):
            if not (pair[0] in self.images and pair[1] in self.images):
                continue
            found, along = self._placed(pair, rows)
            fits = np.isfinite(found).all(1)
            for side, name in enumerate(pair):
                columns = rows[:, side, None].astype(float), along[:, None], found
                places[name].append(np.concatenate(columns, 1)[fits])
        self._rows: dict[str, NDArray[np.int64]] = {}
        self._places: dict[str, NDArray[np.float64]] = {}
        for name, parts in places.items():
            joined = np.concatenate([np.zeros((0, 5)), *parts])
            joined = joined[np.argsort(joined[:, 1], kind="stable")]  # the largest angle between rays first
            rows, first = np.unique(joined[:, 0].astype(np.int64), return_index=True)
            self._rows[name], self._places[name] = rows, joined[first, 2:]

    def _placed(
        self, pair: tuple[str, str], rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the positions ``[m, 3]`` of matches, NaN where they do not fit the cameras, and the rays' cosine."""
        rays = [self._rays[name][rows[:, side]] for side, name in enumerate(pair)]
        centers = [_center(self._poses[name]) for name in pair]
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
            pixels, ahead = self._pixels(name, self._poses[name], place)
            far = np.linalg.norm(pixels - self._features[name][rows[:, side]], axis=1)
            fits &= ahead & (far < _FITTING * self._sizes[name].max())
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

    def explains(self, pair: tuple[str, str]) -> bool:
        """Returns whether at least a few matches of a pair are points of the model; no if it lacks an image."""
        if pair not in self.pairs:
            return False
        rows = self._matches.pairs[pair]
        owners = self._owner[pair[0]][rows[:, 0]], self._owner[pair[1]][rows[:, 1]]
        return bool(((owners[0] == owners[1]) & (owners[0] >= 0)).mean() >= _EXPLAINED)

    def fits(self, pair: tuple[str, str]) -> bool:
        """Returns whether most of a pair's features at points of the model are where their matches are.

        No if they are few. Two rays of a false match may meet, but the point is where the other feature is not.
        """
        rows = self._matches.pairs[pair]
        good: list[NDArray[np.bool_]] = []
        for side, name in enumerate(pair):
            other = pair[1 - side]
            owner = self._owner[name][rows[:, side]]
            places = np.array([self._points[key] for key in owner[owner >= 0]]).reshape(-1, 3)
            pixels, _ = self._pixels(other, self._poses[other], places)
            far = np.linalg.norm(pixels - self._features[other][rows[owner >= 0, 1 - side]], axis=1)
            good.append(far < _SHARED * self._sizes[other].max())
        joined = np.concatenate(good)
        return len(joined) >= STRONG and bool(joined.mean() > _MOST)

    def looks_alike(self, pair: tuple[str, str]) -> bool | None:
        """Returns whether two near images show the same where both show something; None: unknown.

        Where the model does not explain their matches, the images are compared as if the matches were right.
        """
        as_placed = self.explains(pair)
        shares = [self._missing(pair, side, as_placed) for side in range(2)]
        known = [share for share in shares if share is not None]
        if len(known) < 2 or _ALIKE < min(known) < _DIFFERENT:
            return None
        return min(known) <= _ALIKE

    def _missing(self, pair: tuple[str, str], side: int, as_placed: bool) -> float | None:
        """Returns the share of the cells of one image that show nothing that the other one shows there."""
        one, other = pair[side], pair[1 - side]
        partner = np.full(len(self._features[one]), -1)
        partner[self._matches.raw[pair][:, side]] = self._matches.raw[pair][:, 1 - side]
        places, partner = self._places[one], partner[self._rows[one]]
        pose = self._poses[other] if as_placed else self._pose_by(other, places, partner)
        if pose is None:
            return None
        sights = [places - _center(each) for each in (self._poses[one], pose)]
        lengths = [np.linalg.norm(sight, axis=1) for sight in sights]
        cosine = (sights[0] * sights[1]).sum(1) / np.maximum(lengths[0] * lengths[1], 1e-12)
        ratio = lengths[0] / np.maximum(lengths[1], 1e-12)
        size = self._sizes[other]
        pixels, ahead = self._pixels(other, pose, places)
        with np.errstate(invalid="ignore"):
            visible = ahead & (pixels >= 0).all(1) & (pixels < size).all(1)
        near = visible & (cosine > np.cos(np.radians(_NEAR))) & (ratio > 1 / 1.5) & (ratio < 1.5)
        apart = np.linalg.norm(pixels - self._features[other][partner], axis=1)
        with np.errstate(invalid="ignore"):
            shared = (partner >= 0) & (apart < _SHARED * size.max())
        expected = count_cells(pixels[near], size)
        theirs = count_cells(self._features[other][self._rows[other]], size)
        common = count_cells(pixels[near & shared], size)
        alike = common > 0
        if alike.sum() < FEWEST:
            return None
        rate = common[alike].sum() / expected[alike].sum()  # of features found again where both show the same
        compared = (expected >= max(FEWEST, _EXPECTED / rate)) & (theirs >= FEWEST)
        if compared.sum() < _COMPARED:
            return None
        return float((common[compared] == 0).mean())

    def _pose_by(
        self, name: str, places: NDArray[np.float64], partner: NDArray[np.int64]
    ) -> NDArray[np.float64] | None:
        """Returns the pose ``[3, 4]`` of an image by matches of its features with known positions."""
        import pycolmap  # pyright: ignore[reportMissingImports]

        known = partner >= 0
        if known.sum() < STRONG:
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
