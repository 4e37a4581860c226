"""Compiled kernels are never older than the sources they are made of, and need no folder to be kept in."""

import ast
import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from tests.commands import ROOT
from vg2gt.kernels import compiled

CONSTANTS = "LIMIT = {}\n"
KERNEL = """
from vg2gt.kernels.compiled import kernel
from made.constants import LIMIT

@kernel()
def limit():
    return LIMIT
"""
ONE = """
from vg2gt.kernels.compiled import kernel

@kernel()
def add_one(x):
    return x + 1
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a kernel, whose constant is in another file."""
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "kernels.py").write_text(KERNEL)
    monkeypatch.setattr(compiled, "PACKAGES", tmp_path.parent)  # kernels belong to the second level below
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def value_with(constant: int, room: Path) -> int:
    """What the kernel returns in a new process, started after the constant was set."""
    (room / "constants.py").write_text(CONSTANTS.format(constant))
    compiled._folder.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == "made"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    return importlib.import_module("made.kernels").limit()


def test_a_changed_constant_of_another_file_is_used(room: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "vg2gt"
    assert (value_with(1, room), value_with(22, room)) == (1, 22)
    assert len(list(cache.iterdir())) == 2
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")}
    assert value_with(1, room) == 1
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")} == before, "it was compiled again"


def test_without_a_home_kernels_run(room, tmp_path, monkeypatch, caplog):
    """As in a read-only container."""
    missing = tmp_path / "file" / "folder"
    missing.parent.write_text("")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(missing))
    assert value_with(3, room) == 3
    assert "NUMBA_CACHE_DIR" in caplog.text


@pytest.fixture
def make(room: Path):
    """Makes a kernel as another process would."""
    (room / "one.py").write_text(ONE)

    def make() -> Any:
        sys.modules.pop("made.one", None)
        return importlib.import_module("made.one").add_one

    return make


def test_processes_that_compile_at_once_never_run_each_others_code(make) -> None:
    """One begins before the other has kept anything and ends after it: numba would give both one file."""
    first, second = make(), make()
    save, waiting = second._cache._cache_file._save_data, []
    second._cache._cache_file._save_data = lambda *arguments: waiting.append(arguments)
    assert second(1.5) == 2.5
    second._cache._cache_file._save_index({})  # it had read the index before the first wrote to it
    assert first(1) == 2
    save(*waiting[0])
    third = make()
    assert repr((third(1), third(1.5))) == "(2, 2.5)"  # 2, not 2.0


def test_kernels_take_what_they_need_from_their_own_room() -> None:
    """Else the hash would not know of it. Functions of ``numba.njit`` are inlined into kernels and not kept."""
    wrong, kernels = [], 0
    shared = ".".join(compiled.SHARED.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "vg2gt").rglob("*.py"):
        source = path.read_text()
        tree = ast.parse(source)
        imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        if path.name != "compiled.py" and "cache=True" in source and "numba" in source:
            wrong.append(f"{path}: njit(cache=True)")
        if not any(name.name in ("kernel", "kernel_part", "jit", "part") for node in imported for name in node.names):
            continue
        kernels += 1
        room = ".".join(path.relative_to(ROOT).parts[:2])
        compiled_names = {
            name.id
            for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            and any("kernel" in (d := ast.unparse(x)) or d in ("jit", "part") for x in function.decorator_list)
            for name in ast.walk(function)
            if isinstance(name, ast.Name)
        }
        wrong += [
            f"{path}: {name.name} of {node.module}"
            for node in imported
            for name in node.names
            if (name.asname or name.name) in compiled_names - {"kernel", "kernel_part"}
            and (node.module or "").startswith("vg2gt.")
            and not f"{node.module}.".startswith(f"{room}.")
            and node.module != shared
        ]
    assert kernels >= 9
    assert not wrong


def test_kernels_made_in_functions_are_found_again_by_other_processes() -> None:
    """A kernel in a closure has another key in every process, which would compile it again and leave one more file."""
    made = [
        kernel
        for path in sorted((*ROOT.glob("vg2gt/**/*.py"), *ROOT.glob("backends/**/*.py")))
        if "import kernel" in path.read_text()
        for kernel in vars(importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))).values()
        if isinstance(kernel, Dispatcher) and kernel.py_func.__closure__
    ]
    assert len(made) >= 6
    for kernel in made:
        assert all(isinstance(cell.cell_contents, bool) for cell in kernel.py_func.__closure__), kernel
