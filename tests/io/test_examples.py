"""The examples in the docstrings of the formats run as written."""

import doctest
import importlib
import pkgutil

import pytest

import vg2gt.io

MODULES = [f"vg2gt.io.{module.name}" for module in pkgutil.iter_modules(vg2gt.io.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0
