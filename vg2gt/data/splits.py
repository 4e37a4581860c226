"""Divides the scenes of a dataset into training and evaluation lists; recordings of one place stay together."""

from __future__ import annotations

import logging
import zlib
from pathlib import Path

import numpy as np

from vg2gt.data.base import DataError, SceneSource
from vg2gt.io.files import write_text

log = logging.getLogger(__name__)


def split_scenes(source: SceneSource, fraction: float, seed: int = 0) -> tuple[list[str], list[str]]:
    """Divides scenes at random, place by place, and every part of a mixture by itself.

    Args:
        source: the scenes.
        fraction: share of the places of each part that goes to evaluation, but at least one place of it and not all;
            a part with a single place is for training.
        seed: the division is a function of it and of the places' names.

    Returns:
        Names of the training and of the evaluation scenes, in the source's order.

    Raises:
        ValueError: if ``fraction`` is not within (0, 1).
        DataError: if no part has two places.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"fraction must be within (0, 1), got {fraction}")
    evaluation: set[str] = set()
    for part in source.parts():
        places = sorted({source.place(scene) for scene in source.scenes if source.part(scene) == part})
        if len(places) < 2:
            log.warning("%s shows a single place and is for training only", part or "the dataset")
            continue
        order = np.random.default_rng((seed, zlib.crc32(part.encode()))).permutation(len(places))
        count = min(max(1, round(fraction * len(places))), len(places) - 1)
        evaluation |= {places[place] for place in order[:count]}
    if not evaluation:
        place = source.place(source.scenes[0])
        raise DataError(
            f"the dataset shows a single place ({place}): hold frames out of training instead (data.holdout); or, if "
            f"the scenes in a folder {place} are different places, name that folder: data.root=[.../{place}]"
        )
    in_val = {scene: source.place(scene) in evaluation for scene in source.scenes}
    return [scene for scene in in_val if not in_val[scene]], [scene for scene in in_val if in_val[scene]]


def write_splits(out: Path, source: SceneSource, fraction: float, seed: int) -> tuple[Path, Path]:
    """Writes ``train.txt`` and ``val.txt``.

    Raises:
        FileExistsError: if one of them exists with other contents.
    """
    paths = (out / "train.txt", out / "val.txt")
    both = split_scenes(source, fraction, seed)
    texts = [
        f"# {len(names)} scenes; vg2gt data splits --fraction {fraction} --seed {seed}\n"
        + "".join(f"{name}\n" for name in names)
        for names in both
    ]
    for path, text in zip(paths, texts, strict=True):
        if path.exists() and path.read_text() != text:
            raise FileExistsError(f"{path} exists and holds another split: remove it or choose another out=FOLDER")
    for path, text in zip(paths, texts, strict=True):
        write_text(path, text)
    return paths
