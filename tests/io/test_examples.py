"""The examples in the docstrings of the formats and in docs/reference/formats.md run as written."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import vg2gt.io

MODULES = [f"vg2gt.io.{module.name}" for module in pkgutil.iter_modules(vg2gt.io.__path__)]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "formats.md"


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    code, printed = re.findall(r"```(?:python)?\n(.*?)```", PAGE.read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == printed
