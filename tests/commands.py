"""Commands in processes of their own, as a user gives them."""

import multiprocessing
import os
import shlex
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PRELOADED = ["vg2gt.training.loop", "vg2gt.evaluation.run", "vg2gt.studies.ablation"]
VG2GT = "import vg2gt.cli; vg2gt.cli.main()"


def warm_process(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Starts a function in a process that has imported :data:`PRELOADED` already, which takes seconds otherwise."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(PRELOADED)
    process = server.Process(target=target, args=arguments)
    process.start()
    return process


def become(folder: Path | str, outputs: Sequence[Path | str], environment: dict[str, str | None] | None = None) -> None:
    """Makes a warm process what a shell would have started."""
    for descriptor, path in zip((1, 2), (*outputs, outputs[0]), strict=False):
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.dup2(file, descriptor)
        os.close(file)
    os.chdir(folder)
    for name, value in (environment or {}).items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


FRESH = """
import sys
for name in list(sys.modules):
    if name.split(".")[0] in ("vg2gt", "backends"):
        del sys.modules[name]
"""
"""Prefix of code for :func:`run_python` that must import this project itself."""


def _execute(code: str, arguments: list[str], *where: Any) -> None:
    become(*where)
    sys.argv = ["vg2gt", *arguments]
    try:
        exec(compile(code, "run.py", "exec"), {"__name__": "__main__"})
    except Exception:
        traceback.print_exc()
        sys.exit(1)


def run_python(
    code: str, *arguments: str, folder: Path, timeout: float = 500, environment: dict[str, str | None] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs ``python -c CODE ARGUMENTS`` in a folder and a warm process, whatever its outcome."""
    with tempfile.TemporaryDirectory() as temporary:
        outputs = [Path(temporary) / name for name in ("out", "err")]
        process = warm_process(_execute, code, list(arguments), folder, outputs, environment)
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(code, timeout, *(path.read_bytes() for path in outputs))
        return subprocess.CompletedProcess(code, process.exitcode, *(path.read_text() for path in outputs))


def run_vg2gt(*arguments: str, folder: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Runs ``vg2gt ARGUMENTS`` as :func:`run_python` does."""
    return run_python(VG2GT, *arguments, folder=folder, **options)


def printed(line: str, folder: Path, **environment: str) -> str:
    """Runs a ``vg2gt`` line of the documentation, split as a shell does; returns what it printed."""
    program, *arguments = shlex.split(line)
    assert program == "vg2gt"
    done = run_vg2gt(*arguments, folder=folder, environment=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def shell(line: str, folder: Path) -> str:
    """Runs a line in a shell that finds the installed commands; returns what it printed."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        line, shell=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
