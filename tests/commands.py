"""Commands in processes of their own, as a user gives them."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def run_vg2gt(*arguments: str, folder: Path, timeout: float = 500) -> subprocess.CompletedProcess[str]:
    """Runs ``vg2gt ARGUMENTS`` in a folder, whatever its outcome."""
    command = [sys.executable, "-c", "import vg2gt.cli; vg2gt.cli.main()", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=timeout, check=False)


def shell(line: str, folder: Path, **environment: str) -> str:
    """Runs a line of the documentation in a shell; returns what it printed."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **environment}
    done = subprocess.run(
        line, shell=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
