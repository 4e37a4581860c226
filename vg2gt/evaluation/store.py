"""Results of single scenes on disk, written as they are computed, so that an interrupted evaluation can resume."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vg2gt.data.views import SceneSample
from vg2gt.io.files import read_json, write_json

IDENTITY = "identity.json"
FOLDERS = ("scenes", "pictures")
REPORTS = ("metrics.json", "metrics.md")
WRITTEN = (*FOLDERS, *REPORTS, "config.yaml")


class ResultStore:
    """Results of one evaluation, one JSON file per scene.

    Args:
        folder: the evaluation's folder.
        identity: flat settings that affect the metrics; an evaluation already in the folder must have the same.
        overwrite: remove the results that the folder holds, of this or another evaluation.

    Raises:
        FileExistsError: if the folder holds an evaluation with other settings, or files that do not belong to an
            evaluation, which are never replaced.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any], overwrite: bool = False) -> None:
        self.folder = folder
        if not (folder / IDENTITY).is_file():
            foreign = [name for name in WRITTEN if (folder / name).exists()]
            if foreign:
                raise FileExistsError(
                    f"{folder} holds {', '.join(foreign)}, which do not belong to an evaluation (no {IDENTITY}): "
                    "choose another output_dir= or name="
                )
        elif overwrite:
            # the report first: an interruption must not leave it next to other settings
            for name in REPORTS:
                (folder / name).unlink(missing_ok=True)
            for name in FOLDERS:
                shutil.rmtree(folder / name, ignore_errors=True)
        else:
            before = read_json(folder / IDENTITY)
            different = sorted(key for key in before.keys() | identity.keys() if before.get(key) != identity.get(key))
            if different:
                told = ", ".join(f"{key} ({before.get(key)} -> {identity.get(key)})" for key in different)
                raise FileExistsError(
                    f"{folder} holds an evaluation with other settings: {told}; choose another name=, or replace it "
                    "with overwrite=true"
                )
        write_json(folder / IDENTITY, dict(identity))

    def read(self, views: SceneSample) -> dict[str, float | None] | None:
        """Stored metrics of a sample; None if it was not evaluated, or with other frames."""
        path = self._path(views)
        if not path.is_file():
            return None
        stored = read_json(path)
        same = stored["context"] == list(views.context) and stored["target"] == list(views.target)
        return stored["scores"] if same else None

    def write(self, views: SceneSample, metrics: Mapping[str, float | None]) -> None:
        """Writes the metrics of a sample, atomically."""
        frames = {"context": list(views.context), "target": list(views.target)}
        write_json(self._path(views), {"scene": views.scene, **frames, "scores": dict(metrics)})

    def picture(self, views: SceneSample) -> Path:
        """Path of a sample's picture."""
        return self.folder / "pictures" / f"{file_name(views.scene)}-{len(views.context)}.png"

    def _path(self, views: SceneSample) -> Path:
        return self.folder / "scenes" / str(len(views.context)) / f"{file_name(views.scene)}.json"


def file_name(scene: str) -> str:
    """Encodes a scene's name as a file name without slashes, unique per scene."""
    return scene.replace("%", "%25").replace("/", "%2F")
