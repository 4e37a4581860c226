"""Evaluation views, drawn from a seed or read from an index file.

All datasets of the paper are sequences, so views are drawn from a limited range of consecutive frames (paper, appendix
A.1.2). A draw depends only on the seed, the scene's name, its frames and the number of views. An index is a JSON file
with the frame ids of a draw, so that results stay reproducible if the sampling code changes. The packaged index of DTU
holds the paper's three fixed views.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vg2gt.data.base import DataError, SceneSource
from vg2gt.data.views import SceneSample
from vg2gt.io.files import read_json

log = logging.getLogger(__name__)

_INDICES = Path(__file__).resolve().parent / "indices"


@dataclass(frozen=True)
class ViewSelection:
    """Selects input and held-out views of evaluation scenes.

    Args:
        index: name of a packaged index, or path of a JSON file. Scenes and view counts that it lacks are drawn. None:
            draw all.
        targets: maximum number of held-out views per sample.
        spread: N input views and their targets are drawn from ``spread * N`` consecutive frames.
        seed: random seed of the draw.

    Raises:
        ValueError: if a number is out of range.
    """

    index: str | None = None
    targets: int = 4
    spread: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.targets < 0 or self.spread < 1:
            raise ValueError(
                "evaluation.selection needs targets >= 0 and spread >= 1, "
                f"got targets={self.targets}, spread={self.spread}"
            )

    def choose(self, source: SceneSource, scenes: Sequence[str], count: int) -> list[SceneSample]:
        """Returns one sample of ``count`` input views per scene.

        Raises:
            DataError: if a scene has too few frames or lacks a frame of the index, or if an entry of the index has a
                different number of input views or a repeated frame.
        """
        stored = read_index(self.index)
        chosen = [_stored_views(stored, scene, count) or self.draw(source, scene, count) for scene in scenes]
        drawn = [scene for scene in scenes if _stored_views(stored, scene, count) is None]
        if drawn and self.index is not None:
            log.warning(
                "%s has no entry with %d views for %d of %d scenes (first: %s): drawing them with seed %d",
                index_path(self.index).name, count, len(drawn), len(scenes), drawn[0], self.seed,
            )  # fmt: skip
        for views in chosen:
            _check_frames(source, views, count)
        return chosen

    def draw(self, source: SceneSource, scene: str, count: int) -> SceneSample:
        """Draws the views of a scene, in capture order.

        The range of frames starts at a random position. Targets are drawn from the frames that the source holds out or,
        if there are none, from the remaining frames; preferably between the first and the last input view.

        Raises:
            DataError: if the scene has fewer than ``count`` frames that are not held out.
        """
        frames = list(source.frames(scene))
        held_out = set(source.held_out(scene)) & set(frames)
        rng = np.random.default_rng(
            int.from_bytes(hashlib.sha256(f"{self.seed}/{scene}/{count}".encode()).digest(), "big")
        )
        window = self._window(frames, held_out, scene, count, rng)
        inputs = [frame for frame in window if frame not in held_out]
        context = sorted(rng.choice(inputs, count, replace=False).tolist())
        rest = [frame for frame in window if frame not in context and (frame in held_out or not held_out)]
        rest = [frame for frame in rest if context[0] < frame < context[-1]] or rest
        target = sorted(rng.choice(rest, min(self.targets, len(rest)), replace=False).tolist()) if rest else []
        return SceneSample(scene, tuple(context), tuple(target))

    def _window(
        self, frames: list[int], held_out: set[int], scene: str, count: int, rng: np.random.Generator
    ) -> list[int]:
        """Returns ``spread * count`` consecutive frames, or more if the inputs and one held-out frame need it."""
        available = [frame for frame in frames if frame not in held_out]
        if len(available) < count:
            raise DataError(
                f"scene {scene} has {len(available)} frames that are not held out, views={count} needs {count}: ask "
                "for fewer views, or leave the scene out (data.eval_scenes, data.val.scenes)"
            )
        length = min(len(frames), max(round(self.spread * count), count + (0 if held_out else self.targets)))
        start = int(rng.integers(len(frames) - length + 1))
        needs_held_out = bool(held_out) and self.targets > 0

        def suffices(window: list[int]) -> bool:
            inputs = sum(frame not in held_out for frame in window)
            return inputs >= count and (inputs < len(window) or not needs_held_out)

        while not suffices(frames[start : start + length]):
            length = min(len(frames), length + 1)
            start = min(start, len(frames) - length)
        return frames[start : start + length]


def index_path(name: str) -> Path:
    """Returns the file of an index, given the name of a packaged index or a path ending in ``.json``."""
    return Path(name).expanduser() if name.endswith(".json") else _INDICES / f"{name}.json"


def read_index(name: str | None) -> Mapping[str, Mapping[str, Any]]:
    """Reads an index: scene -> number of views -> ``context`` and ``target`` frame ids; empty if ``name`` is None.

    Also reads the indices of pixelSplat and its successors (scene -> ``context`` and ``target``, or null).

    Raises:
        FileNotFoundError: if the index does not exist; the message lists the packaged ones.
        ValueError: if the file is not an index.
    """
    if name is None:
        return {}
    path = index_path(name)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in _INDICES.glob("*.json")))
        raise FileNotFoundError(
            f"evaluation.selection.index={name}: no file {path}; available: {known}; create others with "
            "`vg2gt data views`, or draw the views with evaluation.selection.index=null"
        )
    content = read_json(path)
    scenes = content.get("scenes") if isinstance(content, dict) else None
    if scenes is None and isinstance(content, dict) and any(_is_entry(entry) for entry in content.values()):
        scenes = {scene: {str(len(v["context"])): v} for scene, v in content.items() if _is_entry(v)}
    if not isinstance(scenes, dict) or not all(_is_entry(v) for views in scenes.values() for v in views.values()):
        raise ValueError(f"{path} is not an index of evaluation views (scenes -> number -> context, target)")
    return scenes


def make_index(selection: ViewSelection, source: SceneSource, scenes: Sequence[str], counts: Sequence[int]) -> dict:
    """Returns the content of an index file: the views that ``selection`` draws for each scene and number of views."""
    drawn = {scene: {count: selection.draw(source, scene, count) for count in sorted(counts)} for scene in scenes}
    return {
        "seed": selection.seed,
        "spread": selection.spread,
        "targets": selection.targets,
        "scenes": {
            scene: {
                str(count): {"context": list(chosen.context), "target": list(chosen.target)}
                for count, chosen in views.items()
            }
            for scene, views in drawn.items()
        },
    }


def _is_entry(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(value.get(key), list) for key in ("context", "target"))


def _stored_views(stored: Mapping[str, Mapping[str, Any]], scene: str, count: int) -> SceneSample | None:
    entry = stored.get(scene, {}).get(str(count))
    return SceneSample(scene, tuple(entry["context"]), tuple(entry["target"])) if entry else None


def _check_frames(source: SceneSource, views: SceneSample, count: int) -> None:
    if len(views.context) != count or len(set(views.frames)) != len(views.frames):
        raise DataError(
            f"the evaluation views of scene {views.scene} must be {count} distinct input views and distinct held-out "
            f"views, got input {list(views.context)}, held out {list(views.target)}; correct the index, or draw views "
            "with evaluation.selection.index=null"
        )
    missing = sorted(set(views.frames) - set(source.frames(views.scene)))
    if missing:
        raise DataError(
            f"the evaluation needs frames {missing} of scene {views.scene}, which the data lacks: use the data options "
            "that the index was created with (data.every), or draw views with evaluation.selection.index=null"
        )
