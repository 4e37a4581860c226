"""Commands that compute run on mimalloc, unless somebody says otherwise; the programs they start do not."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from vg2gt.cli import allocator
from vg2gt.cli.allocator import CHOICE, mimalloc_environment

ROOT = Path(__file__).resolve().parents[2]
BEGIN = "import sys; import vg2gt.cli.allocator as allocator; "
SAY = (
    "allocator.start_with_mimalloc(); import os; "
    "print('libmimalloc' in open('/proc/self/maps').read(), sys.argv[1:], "
    "sorted(name for name in os.environ if name.startswith(('LD_PRELOAD', 'MIMALLOC', 'ONEDNN', 'VG2GT'))))"
)


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CHOICE)  # conftest.py sets it
    if not mimalloc_environment():
        pytest.skip("no mimalloc for this system (cmeel-mimalloc)")


def _said(before: str = "", **variables: str) -> str:
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **variables}
    command = [sys.executable, "-c", f"{BEGIN}{before}{SAY}", "a=1", "b c"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=False)
    return done.stdout.strip() or done.stderr.strip().splitlines()[-1]


def test_a_command_starts_again_once_and_leaves_nothing_to_its_children() -> None:
    assert _said() == "True ['a=1', 'b c'] ['ONEDNN_PRIMITIVE_CACHE_CAPACITY']"


@pytest.mark.parametrize(
    ("before", "variables"),
    [
        ("sys.settrace(lambda *event: None); ", {}),
        ("sys.setprofile(lambda *event: None); ", {}),
        ("sys.modules['torch'] = sys; ", {}),
        ("sys.modules['IPython'] = sys; ", {}),
        ("sys.ps1 = '>>> '; ", {}),
        ("", {"VG2GT_ALLOCATOR": "system"}),
    ],
)
def test_it_stays_as_it_is(before: str, variables: dict[str, str]) -> None:
    assert _said(before, **variables) == f"False ['a=1', 'b c'] {sorted(variables)}"


def test_a_library_that_somebody_preloads_stays() -> None:
    assert _said(LD_PRELOAD="libm.so.6") == "False ['a=1', 'b c'] ['LD_PRELOAD']"


def test_given_options_have_the_last_word(monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"MIMALLOC_ALLOW_THP": "1", "MIMALLOC_PURGE_DELAY": "7", "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "9"}
    assert _said(**given) == f"True ['a=1', 'b c'] {sorted(given)}"
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    assert list(mimalloc_environment()) == ["LD_PRELOAD"]


def test_an_unknown_choice_is_named() -> None:
    said = "ValueError: VG2GT_ALLOCATOR=tcmalloc is unknown: choose mimalloc or system"
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), CHOICE: "tcmalloc"}
    command = [sys.executable, str(ROOT / "train.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr.strip()) == (1, said)


def _watching(folder: Path) -> dict[str, str]:
    """An environment in which training says what it runs on instead of training."""
    say = "import os; print('preloaded', 'libmimalloc' in open('/proc/self/maps').read(), flush=True)"
    (folder / "sitecustomize.py").write_text(f"import vg2gt.cli.train as train\ntrain.main = lambda: exec({say!r})\n")
    return {"PATH": os.environ["PATH"], "PYTHONPATH": f"{folder}:{ROOT}"}


@pytest.mark.parametrize(
    "arguments", [[str(ROOT / "train.py")], ["-c", "import vg2gt.cli; vg2gt.cli.console()", "train"]]
)
def test_commands_run_on_it(arguments: list[str], tmp_path: Path) -> None:
    command, watching = [sys.executable, *arguments], _watching(tmp_path)
    done = subprocess.run(command, env=watching, capture_output=True, text=True, timeout=100, check=False)
    assert done.stdout == "preloaded True\n", done.stderr


TRAIN = "print('once', flush=True); import runpy, sys; sys.argv = ['train.py']; "
RUN = f"runpy.run_path({str(ROOT / 'train.py')!r}, run_name='__main__')"
CALL = "sys.argv = [sys.argv[0], 'train']; import vg2gt.cli; vg2gt.cli.main()"


@pytest.mark.parametrize("program", [TRAIN + RUN, TRAIN + CALL])
@pytest.mark.parametrize("piped", [False, True])
def test_a_program_that_runs_a_command_is_not_started_again(program: str, piped: bool, tmp_path: Path) -> None:
    """What it did before would be done twice; what came through a pipe could not even be done again."""
    script = tmp_path / "script.py"
    script.write_text(program)
    arguments = ["-", "a"] if piped else [str(script)]
    done = subprocess.run(
        [sys.executable, *arguments],
        env=_watching(tmp_path),
        input=program if piped else "",
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.stdout == "once\npreloaded False\n", done.stderr


@pytest.mark.parametrize("name", ["with space", "with:colon"])
def test_a_path_that_cannot_be_preloaded_is_left(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = tmp_path / name / "libmimalloc.so"
    library.parent.mkdir()
    library.touch()
    found = SimpleNamespace(name=library.name, locate=lambda: library)
    monkeypatch.setattr(allocator, "files", lambda package: [found])
    assert mimalloc_environment() == {}
    library = library.rename(tmp_path / library.name)
    assert mimalloc_environment()["LD_PRELOAD"] == str(library)
