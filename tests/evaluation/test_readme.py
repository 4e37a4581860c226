"""The README's evaluate line, in a shell, on a run of two steps."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.training_helpers import small_config
from vg2gt.training.loop import train

ROOT = Path(__file__).resolve().parents[2]


def test_the_readmes_line(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    lines = re.findall(r"^python -m vg2gt\.evaluate .*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(lines) == 1
    cache = tmp_path_factory.mktemp("rooms")
    train(small_config(tmp_path / "outputs" / "quickstart", cache, "trainer.max_steps=2"))
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    environment = {**os.environ, "PATH": path, "VG2GT_CACHE": str(cache), "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        lines[0], shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert run.returncode == 0, run.stderr[-3000:]
    folder = tmp_path / "outputs" / "evaluate" / "quickstart-synthetic"
    report = json.loads((folder / "metrics.json").read_text())
    assert set(report["views"]) == {"3", "10", "20"}
    assert all(len(result["scenes"]) == 2 for result in report["views"].values())
    assert "step-2.ckpt (step 2)" in run.stdout
    for heading in ("Rendered depth", "Images", "Rendered normals", "Decoded depth", "Cameras", "Points", "Uniformity"):
        assert f"## {heading}" in run.stdout
    assert (folder / "metrics.md").read_text() in run.stdout
    assert (folder / "config.yaml").is_file()
