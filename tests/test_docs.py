"""What docs/reproduce.md tells to run is there: commands, presets, figures."""

import re

from tests.commands import ROOT
from vg2gt.cli.commands import COMMANDS, DATA_COMMANDS
from vg2gt.config import group_options

TEXT = (ROOT / "docs" / "reproduce.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_commands_and_scripts_exist() -> None:
    scripts = set(re.findall(r"python ([\w/]+\.py)", TEXT))
    assert {"benchmarks/baselines.py", "benchmarks/primitives.py", "benchmarks/stages.py"} <= scripts
    for script in scripts:
        assert (ROOT / script).is_file(), script
    assert {"evaluate", "ablate", "curves"} <= set(re.findall(r"vg2gt (\w+)", TEXT))
    for page in PAGES:
        for name, second in re.findall(r"(?:^|`)vg2gt (\w+) ?(\w*)", page.read_text(), re.MULTILINE):
            assert name in COMMANDS, page
            assert name != "data" or second in DATA_COMMANDS, page


def test_presets_and_files_exist() -> None:
    for group in ("evaluation", "model", "backend", "data", "experiment"):
        named = set(re.findall(rf"(?<![\w.]){group}=([a-z]\w*)", TEXT))
        assert named <= set(group_options(group)), group
    for link in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (ROOT / "docs" / link).exists(), link
    for path in re.findall(r"`((?:docs|vg2gt|configs)/[\w./-]+)`", TEXT):
        assert (ROOT / path).exists(), path
