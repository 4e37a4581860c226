"""Synthetic scenes written as recordings: what comes back, interruptions, workers, the command's arguments."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.cli.data import synthetic as main
from vg2gt.data import DataError, RGBDFolder
from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes

SETTINGS = SceneSettings(frames=2, size=(24, 32), variant=["room", "outdoor"], normals=True)


def _write(out: Path, scenes: int, settings: SceneSettings = SETTINGS, workers: int = 1) -> list[str]:
    return list(write_scenes(out, missing_scenes(out, scenes, 0, settings), settings, workers))


def _digest(out: Path) -> dict[str, str]:
    files = (path for path in sorted(out.rglob("*")) if path.is_file())
    return {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_a_written_scene_is_read_back(tmp_path):
    names = _write(tmp_path / "out", 2)
    assert names == ["room-000000", "outdoor-000001"]
    folder = RGBDFolder(str(tmp_path / "out"), holdout=None)
    source = SETTINGS.source(2, 0)
    assert sorted(folder.scenes) == sorted(names)
    for name in names:
        found, made = folder.load(name, [0, 1]), source.load(name, [0, 1])
        assert torch.equal(found.images, made.images)
        stored = torch.where(made.depth > 65.534, 0, made.depth)
        torch.testing.assert_close(found.depth, stored, atol=5.1e-4, rtol=0)
        torch.testing.assert_close(found.world_to_camera, made.world_to_camera, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.intrinsics, made.intrinsics, atol=1e-4, rtol=0)
        with np.load(tmp_path / "out" / name / "normals" / "00001.npz") as stored_normals:
            normals = torch.from_numpy(stored_normals["normals"].astype(np.float32)).permute(2, 0, 1)
        torch.testing.assert_close(normals, source.normals(name, [1])[0], atol=1e-3, rtol=0)


def test_an_interrupted_run_is_continued(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    _write(whole, 3)
    _write(broken, 1)
    half = broken / ".unfinished" / "outdoor-000001" / "scene"  # as a killed run leaves it
    (half / "images").mkdir(parents=True)
    (half / "images" / "00000.png").write_bytes(b"half a pict")
    (half / "depth").mkdir()
    assert list(RGBDFolder(str(broken)).scenes) == ["room-000000"]  # readers do not see it
    before = (broken / "room-000000" / "images" / "00000.png").stat()
    assert _write(broken, 3) == ["outdoor-000001", "room-000002"]
    assert (broken / "room-000000" / "images" / "00000.png").stat().st_mtime_ns == before.st_mtime_ns
    assert _digest(broken) == _digest(whole)
    assert not (broken / ".unfinished").exists()


def test_workers_do_not_change_files(tmp_path):
    _write(tmp_path / "one", 3)
    assert sorted(_write(tmp_path / "two", 3, workers=2)) == ["outdoor-000001", "room-000000", "room-000002"]
    assert _digest(tmp_path / "one") == _digest(tmp_path / "two")


def test_other_settings_or_another_folder_are_refused(tmp_path):
    _write(tmp_path / "out", 1)
    with pytest.raises(DataError, match="frames=2 instead of 3, normals=True instead of False"):
        missing_scenes(tmp_path / "out", 1, 0, SceneSettings(3, (24, 32), ["room", "outdoor"]))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "mine.jpg").touch()
    with pytest.raises(DataError, match="was not written by this command"):
        missing_scenes(tmp_path / "photos", 1, 0, SETTINGS)
    with pytest.raises(ValueError, match="size two positive numbers"):
        missing_scenes(tmp_path / "new", 1, 0, SceneSettings(size=(24,)))  # pyright: ignore[reportArgumentType]
    assert not (tmp_path / "new").exists()


def test_the_command_writes_and_continues(tmp_path, capsys):
    settings = "--frames 1 --size 24 32 --workers 1 --highlights soft --first-seed 7"
    arguments = ["--out", str(tmp_path / "out"), *settings.split()]
    main([*arguments, "--scenes=1"])
    assert "wrote 1 scenes of 1 frames" in capsys.readouterr().out
    main([*arguments, "--scenes=2"])
    assert "wrote 1 scenes" in capsys.readouterr().out
    assert sorted(RGBDFolder(str(tmp_path / "out")).scenes) == ["room-000007", "room-000008"]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--variant=space", "variant must be one of room, outdoor"),
        ("--workers=0", "--workers must be at least 1"),
        ("--depth-scale=0", "depth_scale must be positive"),
        ("--scenes=0", "num_scenes >= 1"),
    ],
)
def test_wrong_arguments_are_one_clear_error(tmp_path, argument, message):
    with pytest.raises(SystemExit, match="ValueError: ") as error:
        main(["--out", str(tmp_path / "out"), argument])
    assert message in str(error.value)
    assert not list(tmp_path.iterdir())


def test_options_become_settings(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr("vg2gt.cli.data.write_synthetic", lambda *arguments: given.append(arguments))
    main(["--out", "x", "--variant", "room,outdoor", "--size", "56", "112", "--normals", "--depth-scale", "500"])
    main(["--out", "x", "--highlights", "lobes", "--jpeg", "30", "95"])
    assert given[0][3] == SceneSettings(16, (56, 112), ["room", "outdoor"], False, True, 500.0)
    assert given[1][3] == SceneSettings(highlights="lobes", jpeg=[30, 95])
