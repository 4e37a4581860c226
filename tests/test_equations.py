"""docs/concepts/method.md leads from an equation to the code."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "concepts" / "method.md").read_text()
ROWS = re.findall(r"^\| (A?\d*)\s*\| (.+?) \| .+? \| (`vg2gt/.+?`) \|$", TEXT, re.MULTILINE)


def definitions(path: Path) -> set[str]:
    """Functions, and methods as ``Class.method``."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{child.name}" for child in node.body if isinstance(child, ast.FunctionDef)}
    return found


def test_every_numbered_equation_is_in_the_table() -> None:
    assert [number for number, _, _ in ROWS if number] == [*(str(1 + i) for i in range(14)), "A1", "A2"]


@pytest.mark.parametrize(("number", "equation", "places"), ROWS)
def test_the_named_functions_are_there_and_name_the_equation(number: str, equation: str, places: str) -> None:
    """Two files lead to an equation: the table and the one that it names, which has the equation's label."""
    label = equation.strip("`").split("_", 1)[-1]
    named = []
    for place in places.split("; "):
        file, functions = place.split(": ")
        path = ROOT / file.strip("`")
        wanted = re.findall(r"`([\w.]+)`", functions)
        assert wanted
        assert set(wanted) <= definitions(path), f"{file}: {set(wanted) - definitions(path)}"
        named.append(label in path.read_text())
    assert any(named) or not number
