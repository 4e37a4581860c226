"""Compiled kernels are never older than the sources they are made of, and need no folder to be kept in."""

import ast
import importlib.util
import shutil
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


def test_a_changed_constant_of_another_file_is_used(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same sources in another folder share the compiled kernels."""
    cache = tmp_path / "cache" / "vg2gt"
    assert (value_with(1, room), value_with(22, room)) == (1, 22)
    assert len(list(cache.iterdir())) == 2
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")}
    assert value_with(1, room) == 1
    elsewhere = shutil.copytree(room, tmp_path / "elsewhere" / "made")
    monkeypatch.setattr(compiled, "PACKAGES", tmp_path)
    monkeypatch.syspath_prepend(str(elsewhere.parent))
    assert value_with(1, elsewhere) == 1
    assert sys.modules["made"].__path__[0] == str(elsewhere)
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


@pytest.mark.parametrize("ending", ["nbc", "nbi"])
def test_a_damaged_file_is_compiled_again(ending: str, tmp_path: Path, make, caplog: pytest.LogCaptureFixture) -> None:
    make()(1)
    (file,) = (tmp_path / "cache").rglob(f"*.{ending}")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert make()(1) == 2
    assert "compiling it again" in caplog.text
    caplog.clear()
    last = make()
    assert last(1) == 2
    assert not last.stats.cache_misses
    assert not caplog.records


def test_kernels_take_what_they_need_from_their_own_room() -> None:
    """Else the hash would not know of it. Functions of ``numba.njit`` are inlined into kernels and not kept."""
    wrong, kernels = [], 0
    shared = ".".join(compiled.SHARED.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "vg2gt").rglob("*.py"):
        tree = ast.parse(path.read_text())
        imported = {
            alias.asname or alias.name: f"{node.module}."
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        if not {"kernel", "kernel_part", "jit", "part"} & imported.keys():
            continue
        kernels += 1
        own = (".".join(path.relative_to(ROOT).parts[:2]) + ".", f"{shared}.")
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and any(
                "kernel" in (name := ast.unparse(decorator)) or name in ("jit", "part")
                for decorator in function.decorator_list
            ):
                used = {node.id for body in function.body for node in ast.walk(body) if isinstance(node, ast.Name)}
                modules = {imported[name] for name in used & imported.keys()}
                wrong += [f"{path}: {m}" for m in modules if m.startswith("vg2gt.") and not m.startswith(own)]
    assert kernels >= 9
    assert not wrong


def test_kernels_made_in_functions_are_found_again_by_other_processes() -> None:
    """A kernel in a closure has another key in every process, which would compile it again and leave one more file."""
    made = [
        kernel
        for path in sorted((*ROOT.glob("vg2gt/**/*.py"), *ROOT.glob("backends/**/*.py")))
        if "import kernel" in path.read_text()
        for value in vars(importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))).values()
        for kernel in (value.values() if isinstance(value, dict) else (value,))
        if isinstance(kernel, Dispatcher) and kernel.py_func.__closure__
    ]
    assert len(made) >= 9
    for kernel in made:
        assert all(isinstance(cell.cell_contents, bool) for cell in kernel.py_func.__closure__), kernel
