"""Every command of docs/reference/paper-tables.md composes, and every row of the paper's tables has one."""

import re
import shlex
from pathlib import Path

import pytest

from tests.commands import ROOT
from vg2gt.config import compose
from vg2gt.evaluation.paper import tables
from vg2gt.studies.ablation import common_overrides

PAGE = (ROOT / "docs" / "reference" / "paper-tables.md").read_text()
OPTION = re.compile(r'"(--[a-z]+)"')
DATA = dict(re.findall(r"^\| ([\w ]+) \| `((?:--|evaluation)[^`]+)` \|$", PAGE, re.MULTILINE))
ROWS = re.findall(r"^\| .+ \| ([^`|]+) \| `([^`]+)` \|$", PAGE, re.MULTILINE)  # to which words of DATA are added
COMMANDS = [f"{command} {DATA[name]}" for names, command in ROWS for name in names.split(", ")]
TRAIN = next(command for command in re.findall(r"`([^`]+)`", PAGE) if command.startswith("vg2gt train"))
COMMANDS += [f"{TRAIN} {words}" for words in re.findall(r"^\| .+ \| `(name=[^`]+)` \|$", PAGE, re.MULTILINE)]
COMMANDS += [c for c in re.findall(r"`((?:vg2gt|python) [^`]+)`", PAGE) if c not in dict(ROWS).values()]
ELSEWHERE = {"AnySplat", "YoNoSplat", "FreeSplatter", "DepthSplat", "MVSplat", "VolSplat"}  # their own code and weights


@pytest.mark.parametrize("command", COMMANDS)
def test_composes(command: str, tmp_path: Path) -> None:
    program, name, *arguments = shlex.split(command)
    if program == "python":
        assert (ROOT / name).is_file()
        assert {word for word in arguments if word.startswith("--")} <= set(OPTION.findall((ROOT / name).read_text()))
        return
    overrides = [argument for argument in arguments if "=" in argument]
    folders = [arguments[i + 1] for i, argument in enumerate(arguments) if argument == "--config-dir"]
    overrides += [f"hydra.searchpath=[{ROOT / folder}]" for folder in folders]
    settled = ["name=x", f"output_dir={tmp_path}"]
    config = compose(name, *overrides, *settled)
    if name == "ablate":
        compose("train", *common_overrides(overrides), *settled)
        if config.protocol:
            compose("evaluate", f"evaluation={config.protocol}", *config.protocol_overrides, *settled)


def test_vggt_is_evaluated_at_the_papers_size() -> None:
    shown = [shlex.split(command) for command in COMMANDS if "vggt_1b" in command]
    assert len(shown) == 5
    for overrides in shown:
        plugin = f"hydra.searchpath=[{ROOT / 'examples/data_sets/configs'}]"
        config = compose("evaluate", plugin, *(o for o in overrides if "=" in o), "name=x", "output_dir=x")
        assert list(config.data.image_size) == [518, 518]
        assert config.model._target_.endswith("PointCloud")


def commands_of(table: str) -> set[tuple[str, str]]:
    """Label and data set, where it matters, of every row with a command in the section that names a table."""
    section = next(part for part in PAGE.split("\n## ") if f"{table}," in part or f"{table})" in part)
    found, label = set(), ""
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        label = cells[0] or label
        if line.startswith("|") and "`" in cells[-1]:
            names = cells[1].split(", ") if len(cells) == 3 else [""]
            found |= {(plain(one), name) for one in label.split(", ") for name in names}
    return found


def plain(label: str) -> str:
    """A label without what the page adds in brackets or the tables write otherwise."""
    label = label.replace("²", "2").replace("Ours_3DGS", "VG2GT(3DGS)").replace("Ours", "VG2GT")
    return re.sub(r"\((?!3DGS|full).*\)", "", label.replace(" ", "")).lower()


@pytest.mark.parametrize("table", [name for name in tables() if not name.endswith("_256")])
def test_every_row_has_a_command(table: str) -> None:
    """On every data set of the table; the appendix repeats rows of the main tables."""
    if table == "tbl_training_cost":
        assert ("training", "") in commands_of(table)
        return
    known = {"replica": "Replica", "dtu": "DTU", "tat": "Tanks and Temples", "scannet": "ScanNet"}
    there = commands_of(table)
    for data, rows in tables()[table].items():
        for row in set(rows) - ELSEWHERE:
            assert there & {(plain(row), known[data]), (plain(row), "")}, f"{table}: {row} on {data} has no command"


def test_the_appendix_repeats_rows() -> None:
    for name, whole in (("tbl_depth_subset_256", "tbl_depth_whole"), ("tbl_nvs_subset_256", "tbl_nvs_whole")):
        assert name in PAGE
        rows = {plain(row.removesuffix("_256")) for data in tables()[name].values() for row in data}
        assert rows <= {plain(row) for data in tables()[whole].values() for row in data}
