"""Commands and examples of README and docs about scenes run as printed."""

import re
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

import vg2gt.cli
from tests.commands import ROOT
from vg2gt.io import read_cameras_json, read_gaussian_ply


@pytest.fixture
def workplace(run_folder: Path, recording: Path, photos: Path, tmp_path: Path, monkeypatch) -> Path:
    """A folder with a recording, photos and a training run, as the pages name them."""
    (tmp_path / "recording").symlink_to(recording)
    (tmp_path / "photos").symlink_to(photos)
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "quickstart").symlink_to(run_folder)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _commands(page: str, *names: str) -> list[list[str]]:
    lines = re.findall(rf"^vg2gt (?:{'|'.join(names)}) [^#\n]*", (ROOT / page).read_text(), re.MULTILINE)
    return [shlex.split(line) for line in lines]


def _run(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", words)
    vg2gt.cli.main()


def _examples(page: str) -> list[dict[str, Any]]:
    """What the examples of a page leave behind."""
    found: list[dict[str, Any]] = []
    for example in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL):
        found.append({})
        exec(compile(example, page, "exec"), found[-1])
    return found


def test_a_recording_is_reconstructed_and_rendered(workplace: Path, monkeypatch, capsys: pytest.CaptureFixture) -> None:
    (words,) = [words for words in _commands("docs/guides/photos.md", "reconstruct") if "recording/" in words]
    _run(words, monkeypatch)
    assert capsys.readouterr().out.endswith("to look at it: vg2gt view outputs/room --open\n")
    room = workplace / "outputs" / "room"
    assert {p.name for p in room.iterdir()} == {"scene.ply", "cameras.json", "views.npz", "report.png", "report.json"}
    for words in _commands("docs/guides/view.md", "render"):
        if "--path" not in words:  # which names a file of the reader's own
            _run([*words, *(["--seconds", "0.2", "--size", "64x48"] if "--orbit" in words else [])], monkeypatch)
    assert (room / "rasterized" / "depth" / "008.npy").is_file()
    assert (room / "video.gif").is_file()


def test_the_page_on_refinement(workplace: Path, monkeypatch, capsys: pytest.CaptureFixture) -> None:
    commands = _commands("docs/guides/refine.md", "reconstruct", "refine")
    assert {words[1] for words in commands} == {"reconstruct", "refine"}
    for words in commands:
        less = {"--seconds": "0.5", "--refine": "6"}
        short = [less.get(before, word) for before, word in zip(["", *words], words, strict=False)]
        _run([*short, "--quiet", "--device", "cpu"], monkeypatch)
    for scene in ("start/refined", "sharp"):
        assert "refinement" in (workplace / "outputs" / scene / "report.json").read_text()
    capsys.readouterr()
    _examples("docs/guides/refine.md")
    assert capsys.readouterr().out == "True 20\nTrue\n"


def test_python_of_the_readme_and_the_reference(workplace: Path, capsys: pytest.CaptureFixture) -> None:
    """The README's runs twice, here on pictures with known cameras."""
    (workplace / "examples").mkdir()
    (workplace / "examples" / "photos").symlink_to(workplace / "recording")
    out = workplace / "outputs" / "python"
    for _ in range(2):
        (found,) = _examples("README.md")
        assert len(read_gaussian_ply(out / "scene.ply")) == len(found["scene"].gaussians)
        assert "<title>python</title>" in (out / "scene.html").read_text()
    capsys.readouterr()
    assert len(_examples("docs/reference/python.md")) == 2
    assert capsys.readouterr().out == "008 (4, 3, 84, 112) (84, 112)\nTrue True\n(1, 1, 3, 48, 64) 1.95\n"
    assert len(read_cameras_json(out / "cameras.json")) == 4


def test_the_script_from_photos_to_a_scene(workplace: Path, monkeypatch, capsys: pytest.CaptureFixture) -> None:
    """On posed images, so that no structure from motion is needed, with fewer steps."""
    script = (ROOT / "examples" / "photos_to_scene.py").read_text()
    short = workplace / "short.py"
    short.write_text(script.replace("size=280", "size=112").replace("steps=100", "steps=2"))
    assert short.read_text() != script
    monkeypatch.setattr(sys, "argv", [str(short), "recording", "outputs/scene"])
    runpy.run_path(str(short), run_name="__main__")
    assert "Gaussians from 4 views" in capsys.readouterr().out
    assert (workplace / "outputs" / "scene" / "scene.ply").is_file()
