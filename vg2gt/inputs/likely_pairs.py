"""Pairs of photographs that probably show the same things, by the given order and by their features."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

DISTANCES = (1, 2, 4, 8, 16)  # to the paired photographs in the given order
ALIKE = 10  # similar photographs per photograph
_APART = 3  # they are more than this far apart in the order: frames of a video would all be neighbours
_WORDS, _ROUNDS, _SAMPLE = 64, 10, 20_000  # clusters, iterations and sampled features of k-means
_SEED = 0


def likely_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> list[tuple[int, int]]:
    """Returns pairs (earlier, later) of photographs that probably show the same things, sorted by the later one.

    Args:
        descriptors: ``[n, 128]`` SIFT descriptors of each photograph, in order; ``n`` may be 0.
    """
    vectors = _vlad(descriptors)
    likeness = vectors @ vectors.T
    count = len(descriptors)
    pairs = {(i - distance, i) for distance in DISTANCES for i in range(distance, count)}
    for i in range(count):
        taken = [i]
        for j in np.argsort(-likeness[i], kind="stable").tolist():
            if len(taken) > ALIKE:
                break
            if min(abs(j - k) for k in taken) > _APART:
                taken.append(j)
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs, key=lambda pair: pair[::-1])


def _vlad(descriptors: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Returns a unit vector per photograph, ``[N, words * 128]``: summed residuals of features to their words."""
    everything = np.concatenate([np.zeros((0, 128), np.uint8), *descriptors])
    if not len(everything):
        return np.zeros((len(descriptors), 1), np.float32)
    chosen = np.random.default_rng(_SEED).permutation(len(everything))[:_SAMPLE]
    sample = everything[chosen].astype(np.float32)
    words, _ = kmeans2(sample, sample[:_WORDS], _ROUNDS, minit="matrix")
    found = np.zeros((len(descriptors), *words.shape), np.float32)
    for row, own in enumerate(descriptors):
        features = own.astype(np.float32)
        nearest, _ = vq(features, words)
        np.add.at(found[row], nearest, features - words[nearest])
    # Normalise the part of each word first, so that none dominates.
    return _unit(_unit(found).reshape(len(found), -1))


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.sqrt((vectors**2).sum(-1, keepdims=True, dtype=np.float32))
    return vectors / np.maximum(length, np.float32(1e-9))


def descriptors_of(database: Path, names: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Returns the descriptors ``[n, 128]`` of images in a COLMAP database."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    with closing(pycolmap.Database.open(database)) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        return [np.asarray(opened.read_descriptors(numbers[name]).data) for name in names]
