"""A process ends at once after a command that succeeded, and as always after one that did not."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import atexit, sys
from vg2gt.cli.leaving import run_and_leave
class Kept:
    def __del__(self):
        print("taken apart")
kept = Kept()
def command():
    atexit.register(print, "work at the end")
    sys.stdout.write("done ")
    {ending}
run_and_leave(command)
print("after it")
"""


def _run(ending: str) -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(ending=ending)
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)


def test_after_success_nothing_is_taken_apart_and_nothing_is_lost() -> None:
    ended = _run("pass")
    assert (ended.returncode, ended.stdout) == (0, "done after it\nwork at the end\n")


def test_a_failure_keeps_its_status_and_its_message() -> None:
    ended = _run("sys.exit(3)")
    assert (ended.returncode, ended.stdout) == (3, "done work at the end\ntaken apart\n")
    ended = _run("raise ValueError('named')")
    assert ended.returncode == 1
    assert "ValueError: named" in ended.stderr


def test_without_anywhere_to_write_to_it_ends_without_a_word() -> None:
    program = "from vg2gt.cli.leaving import run_and_leave; run_and_leave(lambda: None)"
    command = f'exec "{sys.executable}" -c "{program}" >&-'
    ended = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
