"""`vg2gt view`: what it writes, and one clear line for everything that is wrong."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.io.gaussian_scenes import scene, views
from tests.viewer.reading import read_viewer_html
from vg2gt.cli import view
from vg2gt.io import named_cameras, write_cameras_json, write_gaussian_ply, write_spz
from vg2gt.viewer import scene_title


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with scene.ply, scene.spz, cameras.json and two of its three images."""
    write_gaussian_ply(tmp_path / "scene.ply", scene(60))
    write_spz(tmp_path / "scene.spz", scene(60))
    write_cameras_json(tmp_path / "cameras.json", named_cameras(views(), ["0.png", "1.png", "2.png"]))
    for index in range(2):
        Image.fromarray(np.full((40, 56, 3), 100, np.uint8)).save(tmp_path / f"{index}.png")
    return tmp_path


def run(*arguments: Path | str) -> None:
    view.main([*map(str, arguments)])


@pytest.mark.parametrize("name", ["scene.ply", "scene.spz"])
def test_page_of_a_file(files: Path, capsys: pytest.CaptureFixture, monkeypatch, name: str) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    run(files / name)
    page = files / "scene.html"
    assert len(read_viewer_html(page)) == 60
    assert f"<title>{files.name}</title>" in page.read_text()
    assert page.read_text().count('"picture": "') == 2
    printed = capsys.readouterr().out
    assert f"2 of 3 cameras have their image in {files}" in printed
    assert f"{page}: 60 Gaussians" in printed
    elsewhere = files / "out" / "page.html"
    run(files / name, "--html", elsewhere, "--cameras", files / "cameras.json", "--images", files / "none", "--open")
    assert "photographs are not shown: none in" in capsys.readouterr().out
    assert opened == [elsewhere.as_uri()]


def test_title_is_the_name_of_the_scene_or_its_folder(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (files / "scene.ply").rename(files / "old shed.ply")
    run(files / "old shed.ply")
    assert "<title>old shed</title>" in (files / "old shed.html").read_text()
    inside = files / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)
    names = {"scene.ply": "inside", "../scene.spz": files.name, "../out/../kitchen.v2.ply": "kitchen.v2"}
    assert {name: scene_title(name) for name in names} == names
    assert scene_title("/scene.ply") == "scene"


def test_images_that_reconstruct_writes_are_found(files: Path, capsys: pytest.CaptureFixture) -> None:
    for index in range(2):
        (files / f"{index}.png").unlink()
    images = np.full((3, 400, 560, 3), 100, np.uint8)
    for names, found in (("012", 3), ("019", 2)):
        np.savez(files / "views.npz", images=images, names=np.array(list(names)))
        run(files / "scene.ply")
        assert f"{found} of 3 cameras have their image in {files / 'views.npz'}" in capsys.readouterr().out
    (files / "views.npz").write_bytes(b"nonsense")
    with pytest.raises(SystemExit, match=r"cannot read .*views\.npz"):
        run(files / "scene.ply")


def test_mistakes_end_with_one_line(files: Path) -> None:
    write_gaussian_ply(files / "empty.ply", scene(0))
    (files / "broken.ply").write_bytes(b"ply\nnonsense")
    (files / "0.png").write_bytes(b"nonsense")
    ply = files / "scene.ply"
    cases: list[tuple[tuple[Path | str, ...], str]] = [
        ((files / "absent.ply",), "absent.ply"),
        ((files / "cameras.json",), "expected a scene of Gaussians, .ply"),
        ((files / "broken.ply",), "broken.ply"),
        ((files / "empty.ply",), "empty.ply holds no Gaussians"),
        ((files / "alone" / "scene.ply", "--images", files), "--images requires --cameras"),
        ((ply, "--cameras", ply), "scene.ply: not valid JSON"),
        ((ply, "--cameras", files / "cameras.json"), "0.png"),
    ]
    for arguments, message in cases:
        with pytest.raises(SystemExit) as ended:
            run(*arguments)
        said = str(ended.value.code)
        assert message in said
        assert "\n" not in said
    assert not (files / "scene.html").exists()


def test_a_folder_that_cannot_be_written_to_is_named_before_the_scene_is_read(files: Path, monkeypatch) -> None:
    monkeypatch.setattr("vg2gt.io.read_gaussians", lambda *_: pytest.fail("read"))
    with pytest.raises(SystemExit, match=r"folder .*scene\.ply cannot be written to.*choose another"):
        run(files / "scene.ply", "--html", files / "scene.ply" / "page.html")
