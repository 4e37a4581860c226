"""What docs/reproduce.md tells to run is there: commands, presets, figures."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from vg2gt.config import config_dir

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "reproduce.md").read_text()


def test_modules_and_scripts_exist() -> None:
    modules = set(re.findall(r"python -m ([\w.]+)", TEXT))
    scripts = set(re.findall(r"python ([\w/]+\.py)", TEXT))
    assert {"vg2gt.evaluate", "vg2gt.studies.ablation", "vg2gt.studies.curves"} <= modules
    assert {"benchmarks/baselines.py", "benchmarks/primitives.py", "benchmarks/stages.py"} <= scripts
    for module in modules:
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module
    for script in scripts:
        assert (ROOT / script).is_file(), script


def test_presets_and_files_exist() -> None:
    for group in ("evaluation", "model", "backend", "data", "experiment"):
        for option in set(re.findall(rf"(?<![\w.]){group}=([a-z]\w*)", TEXT)):
            assert (Path(config_dir()) / group / f"{option}.yaml").is_file(), f"{group}={option}"
    for link in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (ROOT / "docs" / link).exists(), link
    for path in re.findall(r"`((?:docs|vg2gt|configs)/[\w./-]+)`", TEXT):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("module", ["vg2gt.studies.curves", "vg2gt.studies.ablation"])
def test_commands_explain_themselves(module: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", module, "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr[-2000:]
    assert "usage" in shown.stdout or "Configuration groups" in shown.stdout
