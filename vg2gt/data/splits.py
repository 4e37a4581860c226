"""Splits the scenes of a dataset into training and evaluation lists; recordings of one place stay together."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vg2gt.data.base import DataError, SceneSource
from vg2gt.io.files import write_text


def split_scenes(source: SceneSource, fraction: float, seed: int = 0) -> tuple[list[str], list[str]]:
    """Splits scenes at random by place.

    Args:
        source: the scenes; not a mixture, whose parts take a list each.
        fraction: fraction of the places that is used for evaluation, at least one place and never all.
        seed: random seed; the split depends only on it and on the names of the places.

    Returns:
        Names of the training scenes and of the evaluation scenes, in the source's order.

    Raises:
        ValueError: if ``fraction`` is not in (0, 1).
        DataError: if there is a single place, or the source is a mixture.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"fraction must be within (0, 1), got {fraction}")
    if len(source.parts()) > 1:
        raise DataError(f"a mixture is split part by part: choose the dataset of one of {', '.join(source.parts())}")
    places = sorted({source.place(scene) for scene in source.scenes})
    if len(places) < 2:
        raise DataError(
            f"the dataset shows a single place ({places[0]}): hold frames out of training instead (data.holdout); or, "
            f"if the scenes in a folder {places[0]} are different places, name that folder: data.root=[.../{places[0]}]"
        )
    order = np.random.default_rng((seed, 0)).permutation(len(places))
    count = min(max(1, round(fraction * len(places))), len(places) - 1)
    evaluation = {places[place] for place in order[:count]}
    in_val = {scene: source.place(scene) in evaluation for scene in source.scenes}
    return [scene for scene in in_val if not in_val[scene]], [scene for scene in in_val if in_val[scene]]


def write_splits(out: Path, source: SceneSource, fraction: float, seed: int) -> tuple[Path, Path]:
    """Writes ``train.txt`` and ``val.txt``.

    Raises:
        FileExistsError: if one of them exists with different contents.
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
            raise FileExistsError(f"{path} exists and holds another split: remove it or choose another --out")
    for path, text in zip(paths, texts, strict=True):
        write_text(path, text)
    return paths
