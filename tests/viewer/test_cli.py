"""`vg2gt view`: what it writes, and one clear line for everything that is wrong."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.io.gaussian_scenes import scene, views
from tests.viewer.reading import read_viewer_html
from vg2gt.cli import view
from vg2gt.io import named_cameras, write_cameras_json, write_gaussian_ply, write_spz
from vg2gt.viewer import server


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
def test_page_of_a_file(files: Path, capsys: pytest.CaptureFixture, name: str) -> None:
    run(files / name, "--cameras", files / "cameras.json", "--html", files / "out" / "page.html")
    assert len(read_viewer_html(files / "out" / "page.html")) == 60
    printed = capsys.readouterr().out
    assert "2 of 3 cameras have their image" in printed
    assert "60 Gaussians" in printed
    page = (files / "out" / "page.html").read_text()
    assert f"<title>{name}</title>" in page
    assert page.count('"picture": "') == 2


def test_images_in_the_folder_that_reconstruct_writes(files: Path, capsys: pytest.CaptureFixture) -> None:
    (files / "images").mkdir()
    for index in range(2):
        (files / f"{index}.png").rename(files / "images" / f"{index}.png")
    arguments = (files / "scene.ply", "--cameras", files / "cameras.json", "--html", files / "page.html")
    run(*arguments)
    assert f"2 of 3 cameras have their image in {files / 'images'}" in capsys.readouterr().out
    assert (files / "page.html").read_text().count('"picture": "') == 2
    run(*arguments, "--images", files)
    assert "photographs are not shown: none in" in capsys.readouterr().out


def test_what_reconstruct_writes_is_found_by_itself(files: Path, capsys: pytest.CaptureFixture) -> None:
    for index in range(2):
        (files / f"{index}.png").unlink()
    write = {"images": np.full((3, 400, 560, 3), 100, np.uint8)}
    np.savez(files / "views.npz", **write)
    run(files / "scene.ply", "--html", files / "page.html")
    assert f"3 of 3 cameras have their image in {files / 'views.npz'}" in capsys.readouterr().out
    assert (files / "page.html").read_text().count('"picture": "') == 3
    np.savez(files / "views.npz", **write, names=np.array(["0", "1", "3"]))  # left by another run
    run(files / "scene.ply", "--html", files / "page.html")
    assert "photographs are not shown: none in" in capsys.readouterr().out
    np.savez(files / "views.npz", images=write["images"][:2])
    run(files / "scene.ply", "--html", files / "page.html")
    assert "photographs are not shown: none in" in capsys.readouterr().out
    (files / "views.npz").write_bytes(b"nonsense")
    with pytest.raises(SystemExit, match=r"cannot read .*views\.npz"):
        run(files / "scene.ply", "--html", files / "page.html")


def test_mistakes_end_with_one_line(files: Path, capsys: pytest.CaptureFixture) -> None:
    write_gaussian_ply(files / "empty.ply", scene(0))
    (files / "broken.ply").write_bytes(b"ply\nnonsense")
    (files / "0.png").write_bytes(b"nonsense")
    html, ply = ("--html", files / "page.html"), files / "scene.ply"
    elsewhere = files / "alone" / "scene.ply"
    cases: list[tuple[tuple[Path | str, ...], str]] = [
        ((files / "absent.ply", *html), "absent.ply"),
        ((files / "cameras.json", *html), "expected a scene of Gaussians, .ply"),
        ((files / "broken.ply", *html), "broken.ply"),
        ((files / "empty.ply", *html), "empty.ply holds no Gaussians"),
        ((ply, *html, "--port", "9000"), "omit --host, --port and --share"),
        ((ply, *html, "--share"), "omit --host, --port and --share"),
        ((elsewhere, *html, "--images", files), "--images requires --cameras"),
        ((ply, *html, "--cameras", ply), "scene.ply: not valid JSON"),
        ((ply, *html, "--cameras", files / "cameras.json"), "0.png"),
        ((ply, "--port", "70000"), "--port"),
    ]
    for arguments, message in cases:
        with pytest.raises(SystemExit) as ended:
            run(*arguments)
        flags = ended.value.code == 2
        said = capsys.readouterr().err.splitlines()[-1] if flags else str(ended.value.code)
        assert said.startswith("vg2gt view: error: ") == flags == ("--" in message)
        assert message in said
        assert "\n" not in said
    assert not (files / "page.html").exists()


def test_without_viser_the_extra_is_named(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"pip install 'vg2gt\[view\]'"):
        run(files / "scene.ply")
