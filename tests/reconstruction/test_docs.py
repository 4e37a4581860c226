"""The commands and the example of docs/guides/photos.md and README.md run as written."""

import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

import vg2gt.cli
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.cli import render as render_command
from vg2gt.io import read_cameras_json
from vg2gt.io.video import has_pyav

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reconstruct.md"


@pytest.fixture
def workplace(run_folder: Path, recording: Path, photos: Path, tmp_path: Path, monkeypatch) -> Path:
    """Where the documentation's commands are given: beside a recording, photographs and a training run."""
    (tmp_path / "recording").symlink_to(recording)
    (tmp_path / "photos").symlink_to(photos)
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "quickstart").symlink_to(run_folder)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _commands(path: Path) -> list[list[str]]:
    lines = re.findall(r"^vg2gt (?:reconstruct|render) [^#\n]*", path.read_text(), re.MULTILINE)
    return [shlex.split(line) for line in lines]


def _run(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs what needs no download; the rest is at least understood."""
    command = {"reconstruct": reconstruct_command, "render": render_command}[words[1]]
    command.parser().parse_args(words[2:])
    found_cameras = "photos/" in words and "backend=" not in words  # these photographs show different things
    if "da3_small" in words or found_cameras or ("video.mp4" in words[-3:] and not has_pyav()):
        return
    monkeypatch.setattr(sys, "argv", words)
    vg2gt.cli.main()


def test_readme(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = _commands(ROOT / "README.md")
    assert len(commands) == 3
    for words in commands:
        _run(words, monkeypatch)
    names = {path.name for path in (workplace / "outputs" / "room").iterdir()}
    assert names == {"scene.ply", "cameras.json", "views.npz", "report.png", "report.json", "video.gif"}
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    found: dict[str, Any] = {}
    exec(compile(example, "README.md", "exec"), found)
    assert len(found["pictures"]) == len(read_cameras_json(workplace / "outputs" / "python" / "cameras.json"))
    assert all(picture.shape[0] == 3 and 0 <= picture.min() <= picture.max() <= 1 for picture in found["pictures"])


def test_page(workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    for words in _commands(PAGE):
        _run(words, monkeypatch)
    assert (workplace / "outputs" / "untrained" / "orbit.gif").is_file()
    assert (workplace / "outputs" / "room" / "rasterized" / "depth" / "008.npy").is_file()
    capsys.readouterr()
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    exec(compile(example, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == "008 (4, 3, 84, 112) (84, 112)\nTrue True\n"
    assert len(read_cameras_json(workplace / "outputs" / "python" / "cameras.json")) == 4
