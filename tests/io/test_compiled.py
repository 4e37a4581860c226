"""Compiled kernels are never older than the sources they are made of, and need no folder to be kept in."""

import ast
import gc
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
from numba.core import event
from numba.core.dispatcher import Dispatcher
from numba.core.errors import TypingError

from tests.commands import ROOT
from vg2gt.io import compiled

CONSTANTS = "LIMIT = {}\n"
KERNEL = """
from vg2gt.io.compiled import kernel
from made.constants import LIMIT

@kernel()
def limit():
    return LIMIT
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a kernel, whose constant stands in another file."""
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "kernels.py").write_text(KERNEL)
    monkeypatch.setattr(compiled, "PACKAGES", tmp_path)
    monkeypatch.setattr(compiled, "ROOMS", ("made",))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def value_with(constant: int, room: Path) -> int:
    """What the kernel returns in a process that starts after the constant was set: all is imported anew."""
    (room / "constants.py").write_text(CONSTANTS.format(constant))
    compiled._folder.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == "made"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    return importlib.import_module("made.kernels").limit()


def test_a_changed_constant_of_another_file_is_used(room: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "vg2gt"
    assert value_with(1, room) == 1
    assert value_with(22, room) == 22
    assert len(list(cache.iterdir())) == 2
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")}
    assert value_with(1, room) == 1
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")} == before, "it was compiled again"


def test_kernels_of_forgotten_versions_are_deleted(room: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "vg2gt"
    old, foreign = cache / f"made-{'0' * 16}", cache / "mine"
    for folder in (old, foreign):
        folder.mkdir(parents=True)
        long_ago = time.time() - 40 * 86400
        os.utime(folder, (long_ago, long_ago))
    value_with(1, room)
    assert not old.exists()
    assert foreign.exists()


@pytest.mark.parametrize("place", ["nowhere", "own", "of_others"])
def test_without_a_home_kernels_run(
    place: str, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A read-only container: what others could write to is not used, for what is kept there is executed."""
    missing = tmp_path / "file" / "folder"
    missing.parent.write_text("")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(missing))
    monkeypatch.setattr(tempfile, "tempdir", str(missing if place == "nowhere" else temporary))
    if place == "of_others":
        (temporary / f"vg2gt-kernels-{os.getuid()}").mkdir()
        (temporary / f"vg2gt-kernels-{os.getuid()}").chmod(0o777)
    assert value_with(3, room) == 3
    assert any(temporary.rglob("*.nbc")) == (place == "own")
    assert ("NUMBA_CACHE_DIR" in caplog.text) == (place != "own")


PARTS = """
from vg2gt.io.compiled import kernel, kernel_part

@kernel_part(error_model="numpy")
def share(x, of):
    return x / of

@kernel(error_model="numpy")
def sum_of_shares(x, of):
    return share(x, of) + share(of, of)
"""


def test_parts_of_kernels_are_compiled_and_kept_with_them_and_interpreted_from_python(
    room: Path, tmp_path: Path
) -> None:
    (room / "parts.py").write_text(PARTS)
    made = importlib.import_module("made.parts")
    assert made.sum_of_shares(3.0, 2.0) == 2.5
    assert made.sum_of_shares(3.0, 0.0) != made.sum_of_shares(3.0, 0.0)  # NaN: numpy's way, no exception
    kept = [path.name.split("-")[0] for path in (tmp_path / "cache").rglob("*.nbc")]
    assert kept == ["parts.sum_of_shares"]
    assert made.share(3.0, 2.0) == 1.5
    with pytest.raises(ZeroDivisionError):
        made.share(3.0, 0.0)


def test_kernels_take_what_they_need_from_their_own_room() -> None:
    """Else the hash would not know of it. Functions of ``numba.njit`` are inlined into kernels and not kept."""
    wrong, kernels = [], 0
    shared = ".".join(compiled.SHARED.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "vg2gt").rglob("*.py"):
        tree = ast.parse(path.read_text())
        imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        source = path.read_text()
        if path.name != "compiled.py" and "cache=True" in source and "numba" in source:
            wrong.append(f"{path}: njit(cache=True)")
        if not any(name.name in ("kernel", "kernel_part", "jit", "part") for node in imported for name in node.names):
            continue
        kernels += 1
        room = ".".join(compiled._room(path).relative_to(ROOT).parts)
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
    """A kernel in a closure has another key in every process, which would compile anew and keep one file more."""
    made = [
        kernel
        for room in compiled.ROOMS
        for path in sorted((ROOT / room).rglob("*.py"))
        if "import kernel" in path.read_text()
        for kernel in vars(importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))).values()
        if isinstance(kernel, Dispatcher) and kernel.py_func.__closure__
    ]
    assert len(made) >= 6
    for kernel in made:
        assert all(isinstance(cell.cell_contents, bool) for cell in kernel.py_func.__closure__), kernel


class CollectorSeen(event.Listener):
    """Whether garbage may be collected, at the beginning of every compilation."""

    def __init__(self) -> None:
        self.seen: list[bool] = []

    def on_start(self, event: event.Event) -> None:
        """Looks."""
        self.seen.append(gc.isenabled())

    def on_end(self, event: event.Event) -> None:
        """Nothing."""


@pytest.mark.parametrize("before", [True, False])
def test_no_garbage_is_collected_while_kernels_are_compiled(before: bool) -> None:
    """After it as before, also where a kernel cannot be compiled or one within another."""
    inner = compiled.numba.njit(lambda x: x + 1)
    kernels = compiled.numba.njit(lambda x: inner(x) + 1), compiled.numba.njit(lambda x: x.nothing_of_the_kind)
    gc.enable() if before else gc.disable()
    try:
        with event.install_listener("numba:compile", CollectorSeen()) as listener:
            assert kernels[0](1) == 3
            assert gc.isenabled() == before
            with pytest.raises(TypingError, match="nothing_of_the_kind"):
                kernels[1](1)
        assert gc.isenabled() == before
    finally:
        gc.enable()
    assert len(listener.seen) >= 3
    assert not any(listener.seen)


@pytest.mark.parametrize(
    ("features", "name", "chosen", "wide"),
    [
        ({"avx512vbmi2": True}, None, None, True),
        ({"avx512vbmi2": False, "avx512f": True}, None, None, False),
        ({}, None, None, False),
        ({"avx512vbmi2": True}, "haswell", None, False),
        ({"avx512vbmi2": True}, None, "+avx2", False),
    ],
    ids=["whole vectors", "processors that slow down", "unknown", "another processor chosen", "features chosen"],
)
def test_vectors_are_as_wide_as_the_processor_is_fast(
    features: dict[str, bool], name: str | None, chosen: str | None, wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    config: Any = compiled.numba.config  # pyright: ignore[reportPrivateImportUsage]
    monkeypatch.setattr(config, "CPU_NAME", name)
    monkeypatch.setattr(config, "CPU_FEATURES", chosen)
    monkeypatch.setattr(compiled, "_cpu_features", lambda: features)
    compiled.use_wide_vectors()
    found = config.CPU_FEATURES
    assert (found or "").endswith(",-prefer-256-bit") == wide
    assert wide or found == chosen


ADD = """
from vg2gt.io.compiled import numba

@numba.njit("void(float32[::1], float32[::1])")
def add(x, y):
    for i in range(len(x)):
        x[i] += y[i]

print(*add.inspect_asm().values())
"""


@pytest.mark.skipif(not compiled._cpu_features().get("avx512vbmi2"), reason="a processor without such vectors")
def test_kernels_compute_with_whole_vectors() -> None:
    """In a process of its own: numba asks once."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_CPU")}
    shown = subprocess.run(
        [sys.executable, "-c", ADD], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert "zmm" in shown.stdout
