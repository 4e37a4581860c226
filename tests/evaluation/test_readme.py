"""The README's evaluate line on a run of two steps."""

import json
import re
from pathlib import Path

from tests.commands import ROOT, printed
from tests.training_helpers import small_config
from vg2gt.training.loop import train


def test_the_readmes_line(tmp_path: Path, cache: Path) -> None:
    """The line as printed; later overrides make it short."""
    lines = re.findall(r"^vg2gt evaluate .*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(lines) == 1
    train(small_config(tmp_path / "outputs" / "quickstart", cache, "trainer.max_steps=2"))
    text = printed(f"{lines[0]} data.image_size=[28,56] data.cache_dir={cache}", tmp_path)
    folder = tmp_path / "outputs" / "evaluate" / "quickstart-synthetic"
    report = json.loads((folder / "metrics.json").read_text())
    assert set(report["views"]) == {"3", "10", "20"}
    assert all(len(result["scenes"]) == 2 for result in report["views"].values())
    assert "step-2.ckpt (step 2)" in text
    for heading in ("Rendered depth", "Images", "Rendered normals", "Decoded depth", "Cameras", "Points", "Uniformity"):
        assert f"## {heading}" in text
    assert (folder / "metrics.md").read_text() in text
    assert (folder / "config.yaml").is_file()
