"""Every command of docs/reference/paper-tables.md composes, and every row of the paper's tables has one."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.evaluation.paper import tables
from vg2gt.studies.ablation import common_overrides

PAGE = (ROOT / "docs" / "reference" / "paper-tables.md").read_text()
COMMANDS = re.findall(r"`((?:vg2gt|python) [^`]+)`", PAGE)
ELSEWHERE = {"AnySplat", "YoNoSplat", "FreeSplatter", "DepthSplat", "MVSplat", "VolSplat"}  # their own code and weights


def own_keys(script: str) -> set[str]:
    """The ``key=value`` pairs of a benchmark that are not Hydra's."""
    found = re.search(r"^DEFAULTS = (\{.*\})$", (ROOT / script).read_text(), re.MULTILINE)
    return set(ast.literal_eval(found[1])) if found else set()


@pytest.mark.parametrize("command", COMMANDS)
def test_composes(command: str, tmp_path: Path) -> None:
    program, name, *arguments = shlex.split(command)
    own = own_keys(name) if program == "python" else set()
    overrides = [argument for argument in arguments if "=" in argument and argument.split("=")[0] not in own]
    settled = ["name=x", f"output_dir={tmp_path}"]
    if program == "python":
        assert (ROOT / name).is_file()
        options = re.findall(
            r'"(--[a-z]+)"', (ROOT / name).read_text() + (ROOT / "benchmarks" / "common.py").read_text()
        )
        assert {a for a in arguments if a.startswith("--")} <= set(options)
        name = "train"
    config = compose(name, *overrides, *settled)
    if name == "ablate":
        compose("train", *common_overrides(overrides), *settled)
        if config.protocol:
            compose("evaluate", f"evaluation={config.protocol}", *config.protocol_overrides, *settled)


def test_vggt_is_evaluated_at_the_papers_size() -> None:
    shown = [shlex.split(command)[2:] for command in COMMANDS if "vggt_1b" in command]
    assert len(shown) == 5
    for overrides in shown:
        config = compose("evaluate", *overrides, "name=x", "output_dir=x")
        assert list(config.data.image_size) == [518, 518]
        assert config.model._target_.endswith("PointCloud")


def test_every_row_and_table_is_there() -> None:
    scored = {name: table for name, table in tables().items() if name != "tbl_training_cost"}
    rows = {row.removesuffix("_256") for table in scored.values() for data in table.values() for row in data}
    labels = PAGE.replace("²", "2").replace(" ", "").lower()
    ours = {row.replace("Ours_3DGS", "VG2GT(3DGS)").replace("Ours", "VG2GT") for row in rows - ELSEWHERE}
    assert {row for row in ours if row.replace(" ", "").lower() not in labels} == set()
    assert all(table in PAGE for table in tables())
