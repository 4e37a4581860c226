"""docs/paper.md's way from an equation to the code leads there."""

import ast
import re
from pathlib import Path

import pytest

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
