"""Mixture of several datasets with sampling weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, zip_longest
from typing import Any

from vg2gt.data.base import DataError, Frames, SceneSource, SourceMaker, made


class Mixture(SceneSource):
    """Weighted mixture of named datasets (paper, Datasets: Infinigen, KITTI and ScanNet).

    Scenes are named ``<part>/<scene>``. Training draws parts in proportion to their weights, whatever their number of
    scenes, and the scenes of a part equally often (``ScenePool``). The proportions are exact if the number of views is
    fixed, and hold in expectation if it varies (``ViewSampler.slots``).

    Args:
        parts: datasets by name, or factories of them (``_partial_: true``).
        weights: sampling weight of every part, on any positive scale; a part of weight 0 is skipped and needs no data.
        common: arguments of the factories: ``<part>_<argument>`` goes to one part, any other to all parts.

    Raises:
        ValueError: if parts and weights do not match, or a part is a mixture.
        FileNotFoundError: if a part's root is not given or does not exist.
        DataError: if a part has no scene.
    """

    def __init__(
        self,
        parts: Mapping[str, SceneSource | SourceMaker],
        weights: Mapping[str, float],
        **common: Any,
    ) -> None:
        _check(parts, weights)
        self.weights = {name: weights[name] for name in parts if weights[name] > 0}
        self.sources = {name: _make(name, parts[name], list(parts), common) for name in self.weights}
        if nested := [name for name, source in self.sources.items() if len(source.parts()) > 1]:
            raise ValueError(f"the part {nested[0]} is a mixture itself: name its parts here, with their weights")
        self.is_metric = all(source.is_metric for source in self.sources.values())
        self.has_depth = all(source.has_depth for source in self.sources.values())
        self.dense_depth = all(source.dense_depth for source in self.sources.values())
        self.has_cameras = all(source.has_cameras for source in self.sources.values())
        self._scenes = _interleave(self.sources)

    @property
    def scenes(self) -> Sequence[str]:
        """Scene names, interleaved so that the first few come from all parts."""
        return self._scenes

    def frames(self, scene: str) -> Sequence[int]:
        """Returns the ids of a scene's usable frames."""
        source, name = self._find(scene)
        return source.frames(name)

    def held_out(self, scene: str) -> Sequence[int]:
        """Returns the ids of a scene's held-out frames."""
        source, name = self._find(scene)
        return source.held_out(name)

    def place(self, scene: str) -> str:
        """Returns ``<part>/<place>``."""
        source, name = self._find(scene)
        return f"{self.part(scene)}/{source.place(name)}"

    def parts(self) -> Mapping[str, float]:
        """Returns the weights of the parts."""
        return self.weights

    def part(self, scene: str) -> str:
        """Returns the part that a scene belongs to."""
        return scene.partition("/")[0]

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames of a scene."""
        source, name = self._find(scene)
        return source.load(name, frame_ids)

    def _find(self, scene: str) -> tuple[SceneSource, str]:
        part, _, name = scene.partition("/")
        if part not in self.sources:
            raise DataError(f"no such scene: {scene}; the mixture's parts are {', '.join(self.sources)}")
        return self.sources[part], name


def _check(parts: Mapping[str, object], weights: Mapping[str, float]) -> None:
    bad = [name for name in parts if not name or "/" in name]
    if set(parts) != set(weights) or bad:
        raise ValueError(
            f"a mixture needs one weight for every part, and names without '/': parts {list(parts)}, weights "
            f"{list(weights)}"
        )
    if not all(0 <= weight < float("inf") for weight in weights.values()) or not any(weights.values()):
        raise ValueError(f"weights must be finite, at least 0, and one of them above 0; got {dict(weights)}")


def _make(name: str, part: SceneSource | SourceMaker, names: Sequence[str], common: Mapping[str, Any]) -> SceneSource:
    """Makes a part with the arguments that apply to it."""
    owners = {key: _owner(key, names) for key in common}
    own = {key.removeprefix(f"{name}_"): common[key] for key, owner in owners.items() if owner == name}
    shared = {key: common[key] for key, owner in owners.items() if owner is None}
    if not isinstance(part, SceneSource) and "root" in own and not own["root"]:
        raise FileNotFoundError(
            f"data.{name}_root is not set: name the dataset's folder, or leave it out with data.weights.{name}=0"
        )
    try:
        return made(part, shared | own)
    except (FileNotFoundError, DataError) as error:
        raise type(error)(f"part {name} of the mixture (data.{name}_root): {error}") from error


def _owner(key: str, names: Sequence[str]) -> str | None:
    """Returns the part of an argument ``<part>_<argument>``; None: it applies to all parts."""
    return max((name for name in names if key.startswith(f"{name}_")), key=len, default=None)


def _interleave(sources: Mapping[str, SceneSource]) -> list[str]:
    named = [[f"{part}/{scene}" for scene in source.scenes] for part, source in sources.items()]
    return [name for name in chain.from_iterable(zip_longest(*named)) if name is not None]
