"""The README's evaluate line, in a shell, on a run of two steps."""

import json
import re
from pathlib import Path

import pytest

from tests.commands import ROOT, shell
from tests.training_helpers import small_config
from vg2gt.training.loop import train


def test_the_readmes_line(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    lines = re.findall(r"^vg2gt evaluate .*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(lines) == 1
    cache = tmp_path_factory.mktemp("rooms")
    train(small_config(tmp_path / "outputs" / "quickstart", cache, "trainer.max_steps=2"))
    printed = shell(lines[0], tmp_path, VG2GT_CACHE=str(cache))
    folder = tmp_path / "outputs" / "evaluate" / "quickstart-synthetic"
    report = json.loads((folder / "metrics.json").read_text())
    assert set(report["views"]) == {"3", "10", "20"}
    assert all(len(result["scenes"]) == 2 for result in report["views"].values())
    assert "step-2.ckpt (step 2)" in printed
    for heading in ("Rendered depth", "Images", "Rendered normals", "Decoded depth", "Cameras", "Points", "Uniformity"):
        assert f"## {heading}" in printed
    assert (folder / "metrics.md").read_text() in printed
    assert (folder / "config.yaml").is_file()
