"""The front door: every command explains itself at once, and says in one line what is wrong."""

import logging
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hydra.errors import HydraException

from tests.commands import shell
from vg2gt import __version__
from vg2gt.cli import main
from vg2gt.cli.arguments import without_patterns
from vg2gt.cli.commands import COMMANDS, DATA_COMMANDS, Command, dispatch
from vg2gt.outputs.output_names import OUTPUTS

Said = Callable[..., tuple[object, str]]

ALL: dict[tuple[str, ...], Command] = {(name,): command for name, command in COMMANDS.items()}
ALL |= {("data", name): command for name, command in DATA_COMMANDS.items()}

# Runs in one process all helps; torch and Lightning must not be imported for any, nor by what starts captures.
HELPS = """
import sys
from vg2gt.cli import captures, main
for words in {words}:
    sys.argv = ["vg2gt", *words, "--help"]
    print("HELP OF", *words)
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, words
    assert not {{"torch", "lightning"}} & set(sys.modules), words
"""


@pytest.fixture(scope="module")
def helps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    script = HELPS.format(words=list(ALL))
    folder = tmp_path_factory.mktemp("empty")
    shown = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, check=False)
    assert shown.returncode == 0, shown.stderr[-3000:]
    assert not list(folder.iterdir())
    texts = shown.stdout.split("HELP OF ")[1:]
    return {text.partition("\n")[0]: text for text in texts}


def test_a_shell_finds_the_installed_command(tmp_path: Path) -> None:
    assert f"vg2gt {__version__}" in shell("vg2gt --version", tmp_path)


def test_help_shows_an_example_and_of_a_training_every_group_and_imports_little(helps: dict[str, str]) -> None:
    for words, command in ALL.items():
        assert command.example in helps[" ".join(words)]
        assert f"{command.example} ".startswith(f"vg2gt {' '.join(words)} ")
    for group in ("ablation", "backend", "data", "experiment", "logger", "loss", "model", "renderer"):
        assert f"\n{group}: " in helps["train"]
        assert f"\n{group}: " in helps["ablate"]
    assert len(helps["reconstruct"].strip().splitlines()) <= 61  # with the line that names it


def test_outputs_are_listed_without_images(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["vg2gt", "reconstruct", "--save", "help"])
    with suppress(SystemExit):
        main()
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(OUTPUTS)


def test_the_front_door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def said(program: str, *words: str) -> str:
        monkeypatch.setattr(sys, "argv", [program, *words])
        with suppress(SystemExit):
            dispatch(program, COMMANDS if program == "vg2gt" else DATA_COMMANDS)
        return "".join(capsys.readouterr())

    assert said("vg2gt") == said("vg2gt", "--help")
    shown = said("vg2gt")
    assert all(command.does in shown and command.example in shown for command in COMMANDS.values())
    assert said("vg2gt", "--version") == f"vg2gt {__version__}\n"
    assert said("vg2gt", "trian") == "vg2gt: unknown command 'trian', did you mean train? (vg2gt --help lists all)\n"
    assert "did you mean splits?" in said("vg2gt data", "split")
    assert said("vg2gt", "zzz") == "vg2gt: unknown command 'zzz' (vg2gt --help lists all)\n"
    monkeypatch.chdir(tmp_path)
    Path("-1.jpg").touch()
    said("vg2gt", "reconstruct", "-1.jpg", "--out", "o")
    assert sys.argv[1:] == ["./-1.jpg", "--out", "o"]  # a file, no flag


@pytest.fixture
def said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Said]:
    """Runs ``vg2gt WORDS`` in an empty folder of this process; what it ends with, and what it has written to stderr."""
    root = logging.getLogger()
    before = root.handlers[:], root.level

    def run(*words: str) -> tuple[object, str]:
        monkeypatch.setattr(sys, "argv", ["vg2gt", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr().err

    monkeypatch.chdir(tmp_path)
    yield run
    root.handlers, root.level = before  # Hydra's are for its process


MISTAKES = {
    "train trainer.max_steps=abc": "TypeError: .*; is a value of the wrong type.*: trainer.max_steps=abc ",
    "train name=../x": "InterpolationResolutionError: .* name=../x must be a path inside outputs",
    "train data=rgbd data.root=not_here": "the data folder not_here .* does not exist: set data.root=",
    "reconstruct . --out x backend=da3_smal": "Could not find 'backend/da3_smal' Available options .*da3_small",
    "reconstruct . --out x --save scene.fbx": "unknown output 'scene.fbx'",
    "reconstruct . --out x foo=1": "option 'foo=1': expected key=value with a key of backend, model, renderer",
    "render scene.ply --cameras no.json --out x": r"^FileNotFoundError: no cameras at no\.json",
    "reconstruct . --out x --max-images 0": "^ValueError: max_images must be at least 1, got 0",
    "export backend=oracle --out bundle": "backend oracle cannot be exported",
    "calibrate": r"there is no place for the calibration: give out=FILE\.json",
    "data views --out views.json evaluation=nonsense": "Could not find 'evaluation/nonsense' Available options",
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistakes_are_one_line(words: str, said: Said, tmp_path: Path) -> None:
    line, logged = said(*words.split())
    assert isinstance(line, str)
    assert re.search(MISTAKES[words], line), line
    assert line.endswith("(HYDRA_FULL_ERROR=1 shows where)")
    assert "\n" not in line
    assert "Traceback" not in logged
    assert not list(tmp_path.rglob("config.yaml"))


OVERRIDES = {
    "train model.gausians.splits=4": "Could not override 'model.gausians.splits'",
    "train backend=da3_smal": r"Could not find 'backend/da3_smal'\s+Available options",
}


@pytest.mark.parametrize("words", OVERRIDES)
def test_hydra_says_what_is_wrong_with_an_override(words: str, said: Said, tmp_path: Path) -> None:
    status, printed = said(*words.split())
    assert status == 1
    assert re.search(OVERRIDES[words], printed), printed
    assert not list(tmp_path.rglob("config.yaml"))


WITHOUT_EXTRAS = {
    "train backend=da3_small": "hub",
    "reconstruct clip.mp4 backend=da3_tiny --out x": "video",
    "render scene.ply --cameras cameras.json --save video.mp4 --out x": "video",
    "export backend=da3_tiny --out x": "export",
}


@pytest.mark.parametrize("words", WITHOUT_EXTRAS)
def test_a_missing_optional_package_is_one_line_before_any_work(words, said, tmp_path, monkeypatch):
    for package in ("huggingface_hub", "av", "onnx", "onnxscript"):
        monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "clip.mp4").touch()  # neither it nor scene.ply, which is not there, is looked at
    line, _ = said(*words.split())
    assert isinstance(line, str)
    assert f"'vg2gt[{WITHOUT_EXTRAS[words]}]'" in line, line
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["clip.mp4"]


def test_an_interrupted_command_says_so(said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vg2gt.io.read_gaussians", interrupted)
    monkeypatch.setattr("vg2gt.inputs.camera_files.read_cameras", lambda path: [path])
    assert said("render", "scene.ply", "--cameras", "c.json", "--out", "x") == (130, "interrupted\n")


@pytest.mark.parametrize(
    ("words", "error"),
    [("train backend=dav3", HydraException), ("render x.ply --cameras no.json --out x", FileNotFoundError)],
)
def test_tracebacks_are_there_for_who_asks(words, error, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["vg2gt", *words.split()])
    with pytest.raises(error):
        main()


def test_patterns_that_the_shell_has_not_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in Windows' command prompt: ``photos\\*.jpg`` did not exist."""
    monkeypatch.chdir(tmp_path)
    for name in ("10.jpg", "9.jpg", "a.png", "[b].jpg"):
        (tmp_path / name).touch()
    assert without_patterns(["?.jpg", "1*.jpg", "[b].jpg", "c*.png"]) == ["9.jpg", "10.jpg", "[b].jpg", "c*.png"]
