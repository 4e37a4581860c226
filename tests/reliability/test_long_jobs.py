"""Evaluations, studies and exports that are killed go on with the same command and give the same results."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import EVALUATE, Attempt, Moment
from vg2gt.io.files import read_json


def kill_and_finish(module: str, arguments: list[str], folder: Path, moments: list[Moment], warm: bool = True) -> int:
    """Returns how many of the moments came before the end."""
    kills = 0
    for moment in moments:
        attempt = harness.start(module, arguments, folder, warm)
        if attempt.wait_for(moment):
            attempt.kill()
        assert attempt.status() in (0, -9), attempt.said()[-4000:]
        kills += attempt.status() == -9
    harness.finish(module, arguments, folder, warm)
    return kills


def after_a_scene(attempt: Attempt) -> bool:
    """A scene is evaluated."""
    return any(name.startswith("scenes/2/") for name in attempt.new())


def without_cost(node: Any) -> Any:
    """Without times and memory."""
    if isinstance(node, dict):
        return {k: without_cost(v) for k, v in node.items() if not k.endswith(("_seconds", "_mib"))}
    return node


@pytest.mark.slow
def test_evaluation(tmp_path: Path, cache: Path, whole: Path) -> None:
    def arguments(folder: Path) -> list[str]:
        small = ["data.image_size=[28,56]", "data.eval_scenes=5", "views=[2]", "device=cpu", "name=test"]
        places = [f"output_dir={folder}", f"hydra.run.dir={folder}", f"data.cache_dir={cache}", f"ckpt={run}"]
        return [*small, *places, "evaluation.pictures=2"]

    run, expected, folder = tmp_path / "run", tmp_path / "whole", tmp_path / "killed"
    shutil.copytree(whole, run)
    harness.finish(EVALUATE, arguments(expected), expected)
    kills = kill_and_finish(EVALUATE, arguments(folder), folder, [after_a_scene] * 4)
    results = [read_json(path / "metrics.json") for path in (expected, folder)]
    for result in results:
        del result["settings"]["name"]  # that of the folder
    assert without_cost(results[0]) == without_cost(results[1])
    for path in (expected / "pictures").iterdir():
        assert path.read_bytes() == (folder / "pictures" / path.name).read_bytes()
    print(f"{kills} kills survived: an evaluation")
    assert kills >= 3
