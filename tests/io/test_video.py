import sys
from pathlib import Path

import numpy as np
import pytest

from vg2gt.io import FormatError, read_video, write_video
from vg2gt.io.video import MissingDecoderError, count_frames, has_ffmpeg


def _frames(count: int = 6, size: tuple[int, int] = (32, 48)) -> list[np.ndarray]:
    """A white bar that moves to the right over a colour gradient."""
    y, x = np.mgrid[: size[0], : size[1]]
    base = np.stack((x * 4, y * 6, 0 * x + 90), -1).astype(np.uint8)
    frames = []
    for i in range(count):
        frame = base.copy()
        frame[:, 6 * i : 6 * i + 4] = 255
        frames.append(frame)
    return frames


def test_gif_round_trip(tmp_path: Path) -> None:
    path = write_video(tmp_path / "bar.gif", _frames(), fps=12)
    assert count_frames(path) == 6
    back = dict(read_video(path, every=2))
    assert list(back) == [0, 2, 4]
    for number, frame in back.items():
        assert np.abs(frame.astype(int) - _frames()[number]).mean() < 6


def test_mp4_round_trip(tmp_path: Path) -> None:
    if not has_ffmpeg():
        pytest.skip("there is no ffmpeg")
    path = write_video(tmp_path / "bar.mp4", _frames(size=(33, 48)), fps=12)
    assert [p.name for p in tmp_path.iterdir()] == ["bar.mp4"]
    assert count_frames(path) == 6
    back = dict(read_video(path, every=2))
    assert list(back) == [0, 2, 4]
    for number, frame in back.items():
        assert frame.shape == (32, 48, 3)
        assert np.abs(frame.astype(int) - _frames()[number]).mean() < 12
    (tmp_path / "bad.mp4").write_bytes(path.read_bytes()[:100])
    with pytest.raises(FormatError, match=r"bad.mp4"):
        list(read_video(tmp_path / "bad.mp4"))
    with pytest.raises(FormatError, match=r"bad.mp4"):
        count_frames(tmp_path / "bad.mp4")


def test_frames_of_an_image_stream(tmp_path: Path, monkeypatch) -> None:
    """A stand-in for ffmpeg that answers with two PPM images, the way the real one does."""
    program = tmp_path / "ffmpeg"
    program.write_text(
        f"#!{sys.executable}\n"
        "import sys\n"
        "for shade in (7, 9):\n"
        "    sys.stdout.buffer.write(b'P6\\n3 2\\n255\\n' + bytes([shade]) * 18)\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "clip.mov").touch()
    found = list(read_video(tmp_path / "clip.mov", every=5))
    assert [(number, frame.shape, frame.max()) for number, frame in found] == [(0, (2, 3, 3), 7), (5, (2, 3, 3), 9)]
    assert next(read_video(tmp_path / "clip.mov"))[0] == 0  # stopping early ends the program


def test_missing_ffmpeg_names_the_remedy(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("vg2gt.io.video.has_ffmpeg", lambda: False)
    (tmp_path / "clip.mp4").touch()
    for call in (lambda: count_frames(tmp_path / "clip.mp4"), lambda: write_video(tmp_path / "new.mp4", _frames())):
        with pytest.raises(MissingDecoderError, match=r"pip install 'vg2gt\[video\]'"):
            call()


def test_what_cannot_be_written_or_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "none.gif", [])
    with pytest.raises(ValueError, match="one size"):
        write_video(tmp_path / "two.gif", [*_frames(1), *_frames(1, (16, 16))])
    with pytest.raises(ValueError, match="fps"):
        write_video(tmp_path / "still.gif", _frames(), fps=0)
    with pytest.raises(ValueError, match=r"\.gif or \.mp4"):
        write_video(tmp_path / "film.avi", _frames())
    (tmp_path / "text.gif").write_text("no picture")
    with pytest.raises(FormatError, match="not a GIF"):
        list(read_video(tmp_path / "text.gif"))
    with pytest.raises(FileNotFoundError, match="no video"):
        count_frames(tmp_path / "nowhere.gif")
