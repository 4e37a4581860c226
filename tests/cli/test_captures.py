"""Many captures by one command: each is done once, whatever happens to the others."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.commands import ROOT, VG2GT, run_vg2gt
from tests.data.sources.layout_rgbd import write_recording
from vg2gt.data import SyntheticScenes

SMALL = ["backend=oracle", "--size", "56", "--refine", "0", "--save", "scene.ply", "--device", "cpu", "--each"]


def write_captures(folder: Path, count: int) -> Path:
    """Recordings, the second of them damaged, and a list of them."""
    source = SyntheticScenes(count, num_frames=3, size=(42, 56))
    for scene in source.scenes:
        write_recording(folder, source.load(scene, range(3)), scene)
    (folder / source.scenes[1]).rename(folder / "broken")
    (folder / "broken" / "poses.txt").write_text("no poses")
    (folder / "list.txt").write_text("\n".join(["broken", source.scenes[0], *source.scenes[2:]]))
    return folder / "list.txt"


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    return write_captures(tmp_path / "captures", 3)


def reconstruct(captures: Path, *more: str) -> CompletedProcess[str]:
    return run_vg2gt("reconstruct", str(captures), "--out", "all", *SMALL, *more, folder=captures.parent.parent)


def test_a_broken_capture_is_named_and_the_others_are_done_once(captures: Path) -> None:
    done = reconstruct(captures)
    assert done.returncode == 1
    assert "1 of 3 captures failed: broken" in done.stderr, done.stderr
    out = captures.parent.parent / "all"
    table = (out / "captures.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if "|" in line]
    assert [row[:3] for row in rows[2:]] == [
        ["broken", "failed", ""],
        ["room-000000", "done", "3"],
        ["room-000002", "done", "3"],
    ]
    assert table.count("poses.txt") == 1
    first = out / "room-000000" / "scene.ply"
    written = first.stat().st_mtime_ns
    # one that was interrupted, and one whose cause of failure is mended
    (out / "room-000002" / "capture.json").write_text(json.dumps({"status": "started"}))
    shutil.copy(captures.parent / "room-000000" / "poses.txt", captures.parent / "broken")
    again = reconstruct(captures)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("| done") == 3
    assert first.stat().st_mtime_ns == written
    other = reconstruct(captures, "--min-confidence", "0.5")
    assert "made with other options (min_confidence)" in other.stderr
    assert other.returncode == 1


@pytest.mark.slow
def test_two_captures_at_a_time(captures: Path) -> None:
    if importlib.util.find_spec("hydra_plugins.hydra_joblib_launcher") is None:
        pytest.skip("needs hydra-joblib-launcher")
    done = reconstruct(captures, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    assert "1 of 3 captures failed: broken" in done.stderr, done.stderr
    assert done.stdout.count("| done") == 2


@pytest.mark.slow
def test_forty_captures_killed_and_resumed(tmp_path: Path) -> None:
    """39 scenes, one named, and what was done before the kill is kept."""
    captures = write_captures(tmp_path / "captures", 40)
    command = [sys.executable, "-c", VG2GT, "reconstruct", str(captures), "--out", "all", *SMALL]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    results = tmp_path / "all"
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL) as first:
        while first.poll() is None and len(list(results.glob("*/capture.json"))) < 15:
            time.sleep(0.05)
        first.kill()
    done = {path: path.stat().st_mtime_ns for path in results.glob("*/capture.json") if '"done"' in path.read_text()}
    assert 10 < len(done) < 39
    resumed = reconstruct(captures)
    assert "1 of 40 captures failed: broken" in resumed.stderr, resumed.stderr
    assert resumed.stdout.count("| done") == len(list((tmp_path / "all").glob("*/scene.ply"))) == 39
    assert {path: path.stat().st_mtime_ns for path in done} == done
