"""docs/paper.md's way from an equation to the code leads there; the keys of the deviations from the paper exist."""

import ast
import re
from functools import lru_cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from vg2gt.config import config_dir

ROOT = Path(__file__).resolve().parents[1]
ROWS = re.findall(
    r"^\| ((?:eqn?_|\()\S.*?) \| .+? \| (`vg2gt/.+?) \|$", (ROOT / "docs" / "paper.md").read_text(), re.MULTILINE
)


def definitions(path: Path) -> set[str]:
    """Functions, and methods as ``Class.method``."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{child.name}" for child in node.body if isinstance(child, ast.FunctionDef)}
    return found


def test_there_are_ten_equations() -> None:
    assert len({equation for equation, _ in ROWS if equation.startswith("eq")}) >= 10


@pytest.mark.parametrize(("equation", "places"), ROWS)
def test_the_named_functions_are_there_and_name_the_equation(equation: str, places: str) -> None:
    label = equation.split("_", 1)[-1]
    named = []
    for place in places.split("; "):
        file, functions = place.split(": ")
        path = ROOT / file.strip("`")
        wanted = re.findall(r"`([\w.]+)`", functions)
        assert wanted
        assert set(wanted) <= definitions(path), f"{file}: {set(wanted) - definitions(path)}"
        named.append(label in path.read_text())
    assert any(named) or equation.startswith("(")


DEVIATIONS = (ROOT / "docs" / "reproduce.md").read_text().split("## Deviations from the paper")[1].split("\n## ")[0]
GROUPS = "model|loss|renderer|data|trainer|optimizer"
KEYS = re.findall(rf"`((?:{GROUPS})\.[\w.]+)`(\*?)(?: \(`(\w+)`\))?", DEVIATIONS)


@lru_cache
def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(config_dir(), version_base="1.3"):
        return compose("train", ["output_dir=.", "hydra/job_logging=default", *overrides])


@pytest.mark.parametrize(("key", "starred", "papers"), KEYS)
def test_a_deviations_key_exists_and_the_presets_are_on_the_stated_sides(key: str, starred: str, papers: str) -> None:
    paper, ours = composed("experiment=paper"), composed("experiment=finetune", "data=paper_mix")
    assert OmegaConf.select(ours, key, throw_on_missing=True) is not None or papers == "null"
    if starred:
        default = composed()
        assert str(OmegaConf.select(paper, key)).lower() == papers
        assert OmegaConf.select(ours, key) == OmegaConf.select(default, key) != OmegaConf.select(paper, key)


def test_every_switchable_addition_is_in_the_table() -> None:
    starred = {key for key, star, _ in KEYS if star}
    coarse = {f"model.coarse.{name}" for name in ("surface_evidence", "embedding_skip", "fuse_kernel", "gate")}
    fine = {"model.fine.moments", "model.fine.normal_kernel", "model.fine.drop_fringes"}
    head = {"model.gaussians.anchor", "model.gaussians.start"}
    assert starred == coarse | fine | head | {"model.keep_scale", "model.background"}
    assert {line.count("|") for line in DEVIATIONS.splitlines() if line.startswith("|")} == {5}
