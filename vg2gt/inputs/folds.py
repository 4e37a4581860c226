"""Finds structure that folds onto itself: images of equal sides of an object that were taken for one side.

A model that puts equal sides on top of each other has small errors. The matches of pairs whose surroundings differ
(``pair_evidence.py``) are removed. Where nothing surrounds the sides, images whose matches contradict the model are
what can be found.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vg2gt.inputs.pair_evidence import FEWEST, STRONG, Matches, PairEvidence, count_cells

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

_RIVAL = 0.2  # of an image's best matched pair, from which a contradicted pair counts
_OUTVOTED = 2  # images that tell a pair apart, beyond twice those that do not, though it looks alike itself
_RARE = 0.3  # of an image's matched features: those that are matched in the fewest other images
_FOUND = 2  # matches in a cell that a pair covers
_COVERED = 0.5  # of the cells that the best pair of either image covers: the first models are made of such pairs
_FEWEST_FALSE = 3  # pairs of different places, below which nothing is removed
_MISLED = 0.5  # different pairs per pair that looks alike, below which nothing is removed
_FEWEST_UNDECIDED = 0.1  # of the placed images, and at least three of them
_ROUNDS = 3  # models of pairs that cover most, until none differs


def _views(models: Sequence[Reconstruction], matches: Matches) -> list[PairEvidence]:
    return [PairEvidence(model, matches) for model in models]


def _verdicts(views: Sequence[PairEvidence]) -> dict[tuple[str, str], bool]:
    """Returns which pairs of images, of those that the models put near each other, show the same place."""
    verdict: dict[tuple[str, str], bool] = {}
    for seen in views:
        for pair in seen.pairs:
            alike = seen.looks_alike(pair)
            if alike is not None:
                verdict[pair] = alike
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
    views = _views(models, matches)
    return {
        pair for pair, alike in _verdicts(views).items() if not alike and any(seen.explains(pair) for seen in views)
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

    known = {name: cells(name, np.flatnonzero(chosen)) >= FEWEST for name, chosen in rare.items()}
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
    for seen in _views(models, matches):
        for pair in seen.pairs - fit.keys():
            fit[pair] = seen.fits(pair)
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
    seen = PairEvidence(models[0], matches)
    best: dict[str, int] = {}
    rivals: dict[str, int] = {}
    for pair, rows in matches.pairs.items():
        against = len(rows) >= STRONG and not seen.explains(pair)
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
    verdict = _verdicts(_views(models, matches))
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
        surrounded = _verdicts(_views(models, removed)).items()  # by all that surrounds the images
        alike = {pair for pair, same in surrounded if same}
        matches = matches.without(removed.pairs.keys() - alike)
    undecided |= set(contradicted_images(models, matches))
    enough = max(3, _FEWEST_UNDECIDED * len(models[0].images))
    return models, sorted(undecided) if len(undecided) >= enough else []
