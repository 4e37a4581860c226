"""examples/write_recordings.py: what is read back, and how an interrupted run resumes."""

import sys
from pathlib import Path

import torch

from examples import write_recordings
from vg2gt.data import RGBDFolder, SyntheticScenes


def test_written_scenes_are_read_back_and_an_interrupted_run_is_continued(tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "out"

    def write(scenes: int) -> None:
        small = ["data.num_frames=2", "data.image_size=[24,32]", "data.cache_dir=null"]
        overrides = ["data=synthetic", f"data.train.num_scenes={scenes}", *small]
        monkeypatch.setattr(sys, "argv", ["write_recordings.py", str(out), *overrides])
        write_recordings.main()

    write(1)
    half = out / ".unfinished" / "room-000001" / "scene" / "images"  # as a killed run leaves it
    half.mkdir(parents=True)
    (half / "00000.png").write_bytes(b"half a pict")
    assert list(RGBDFolder(str(out)).scenes) == ["room-000000"]  # readers do not see it
    before = (out / "room-000000" / "K.txt").stat().st_mtime_ns
    write(2)
    assert (out / "room-000000" / "K.txt").stat().st_mtime_ns == before
    assert not (out / ".unfinished").exists()
    folder, source = RGBDFolder(str(out), holdout=None), SyntheticScenes(2, 0, 2, (24, 32))
    assert sorted(folder.scenes) == sorted(source.scenes)
    for name in source.scenes:
        found, made = folder.load(name, [0, 1]), source.load(name, [0, 1])
        assert torch.equal(found.images, made.images)
        torch.testing.assert_close(found.depth, made.depth, atol=5.1e-4, rtol=0)
        torch.testing.assert_close(found.world_to_camera, made.world_to_camera, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.intrinsics, made.intrinsics, atol=1e-4, rtol=0)
