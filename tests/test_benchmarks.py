"""The benchmark scripts run and write what they say, at sizes that measure nothing."""

import re
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def test_every_script_is_in_the_table() -> None:
    scripts = {path.name for path in BENCHMARKS.glob("*.py")} - {"common.py", "stage_clock.py"}
    helpers = {"opensplat.py", "photo_sets.py", "render_scene.py"}
    assert set(re.findall(r"`(\w+\.py)`", (BENCHMARKS / "README.md").read_text())) - {"train.py"} == scripts - helpers
