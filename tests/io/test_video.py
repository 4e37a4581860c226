import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.io import FormatError, read_video, write_video
from vg2gt.io.video import count_frames, read_frame, sharpest_frames, video_size


def _frames(count: int = 6, size: tuple[int, int] = (32, 48)) -> list[np.ndarray]:
    """A white bar that moves to the right over a colour gradient."""
    y, x = np.mgrid[: size[0], : size[1]]
    frames = np.stack((x * 4, y * 6, 0 * x + 90), -1).astype(np.uint8)[None].repeat(count, 0)
    for i, frame in enumerate(frames):
        frame[:, 6 * i : 6 * i + 4] = 255
    return list(frames)


def test_the_same_frames_give_the_same_mp4(tmp_path: Path) -> None:
    """Item 26 of issue 47: encoders with several threads gave other bytes in every second file."""
    noise = np.random.default_rng(0).integers(0, 256, (160, 280, 3)).astype(np.uint8)
    frames = [np.roll(noise, shift, 1) for shift in range(20)]
    files = {write_video(tmp_path / f"{i}.mp4", frames).read_bytes() for i in range(3)}
    assert len(files) == 1


@pytest.mark.parametrize(("suffix", "height", "error"), [("mp4", 32, 12), ("gif", 33, 6)])
def test_round_trip(tmp_path: Path, suffix: str, height: int, error: float) -> None:
    path = write_video(tmp_path / f"12:30.{suffix}", _frames(size=(33, 48)), fps=12)  # no protocol called 12
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert count_frames(path) == 6
    back = dict(read_video(path, range(0, 6, 2)))
    assert list(back) == [0, 2, 4]
    for number, frame in back.items():
        assert frame.shape == (height, 48, 3)
        assert np.abs(frame.astype(int) - _frames(size=(33, 48))[number][:height]).mean() < error
        assert np.array_equal(read_frame(path, number), frame)
    with pytest.raises(FormatError, match=r"has 6 frames, but frame 6 was requested"):
        read_frame(path, 6)


def test_frames_come_upright_and_mirrored_as_the_file_says(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = write_video(tmp_path / "bar.mp4", _frames(1))
    (plain,) = (frame for _, frame in read_video(path))
    content = path.read_bytes()
    start = content.index(b"tkhd") + 44  # the display matrix a b u, c d v, x y w in 16.16
    turns = {
        (0, 1, -1, 0): np.rot90(plain, -1),
        (-1, 0, 0, -1): np.rot90(plain, 2),
        (0, -1, 1, 0): np.rot90(plain),
        (-1, 0, 0, 1): plain[:, ::-1],
        (0, 1, 1, 0): plain.swapaxes(0, 1),
    }
    for (a, b, c, d), expected in turns.items():
        matrix = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
        path.write_bytes(content[:start] + matrix + content[start + 36 :])
        assert [np.array_equal(frame, expected) for _, frame in read_video(path)] == [True]


@pytest.mark.parametrize(("aspect", "size"), [("4/3", (90, 120)), ("8/9", (101, 90)), ("1", (90, 90))])
def test_pixels_that_are_not_square_are_stretched(tmp_path: Path, aspect: str, size: tuple[int, int]) -> None:
    """As of DV, HDV and anamorphic lenses: a circle, stored squeezed, comes back round, also of one frame."""
    av = pytest.importorskip("av")
    height, width = size
    y, x = np.mgrid[:height, :width]
    inside = np.hypot(x - width / 2 + 0.5, y - height / 2 + 0.5) < 30
    circle = np.repeat(np.where(inside, 255, 0).astype(np.uint8)[..., None], 3, -1)
    stored = np.array(Image.fromarray(circle).resize((90, 90)))
    with av.open(str(tmp_path / "squeezed.mp4"), "w") as container:
        stream = container.add_stream("libx264", 10, {"crf": "10"})
        stream.width = stream.height = 90
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        stream.pix_fmt = "yuv444p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(stored, "rgb24")))
        container.mux(stream.encode(None))
    ((_, frame),) = read_video(tmp_path / "squeezed.mp4")
    assert video_size(tmp_path / "squeezed.mp4") == size
    assert np.array_equal(frame, read_frame(tmp_path / "squeezed.mp4", 0))
    rows, columns = np.nonzero(frame[..., 0] > 127)
    assert np.ptp(rows) == pytest.approx(59, abs=1.5)
    assert np.ptp(columns) == pytest.approx(59, abs=1.5)


@pytest.mark.parametrize("said", [True, False])
@pytest.mark.parametrize("step", [0, 6])
def test_half_images_of_two_times_become_the_first(tmp_path: Path, said: bool, step: int) -> None:
    """As of camcorders: the rows of two times are told apart also if the file has lost the flag; else rows are kept."""
    av = pytest.importorskip("av")
    noise = np.random.default_rng(0).uniform(0, 255, (12, 30, 3)).astype(np.uint8)
    scene = np.array(Image.fromarray(noise).resize((300, 120), Image.Resampling.BICUBIC))
    first, second = (scene[:, shift : shift + 192] for shift in (40, 40 + step))
    woven = np.ascontiguousarray(first)
    woven[1::2] = second[1::2]
    with av.open(str(tmp_path / "fields.mp4"), "w") as container:
        stream = container.add_stream("libx264", 25, {"crf": "4", **({"flags": "+ilme+ildct"} if said else {})})
        stream.width, stream.height, stream.pix_fmt = 192, 120, "yuv444p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(woven, "rgb24")))
        container.mux(stream.encode(None))
    with av.open(str(tmp_path / "fields.mp4")) as container:
        assert next(container.decode(video=0)).interlaced_frame == said
    ((_, frame),) = read_video(tmp_path / "fields.mp4")
    assert frame.shape == first.shape
    assert np.abs(frame.astype(int) - first).mean() < 3
    assert step == 0 or np.abs(woven.astype(int) - first).mean() > 9
    assert np.array_equal(frame, read_frame(tmp_path / "fields.mp4", 0))


def test_ten_bits_are_read_as_eight(tmp_path: Path) -> None:
    """As HDR videos of phones have."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "deep.mkv"), "w") as container:
        stream = container.add_stream("libx264", 10, {"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p10le"
        for frame in _frames():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode(None))
    read = list(read_video(tmp_path / "deep.mkv"))
    assert len(read) == 6
    for number, frame in read:
        assert frame.dtype == np.uint8
        assert np.abs(frame - _frames()[number].astype(int)).mean() < 12


def test_the_video_is_read_not_the_preview_before_it(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "two.mkv"), "w") as container:
        streams = [container.add_stream("libx264", 10, {"bf": "0"}) for _ in range(2)]
        for stream, size, disposition in zip(streams, (16, 32), (0, 1), strict=True):  # 1: to be shown
            stream.width, stream.height, stream.pix_fmt = 2 * size, size, "yuv420p"
            stream.disposition = disposition
        for frame in _frames(5, (32, 64)):
            for stream, step in zip(streams, (2, 1), strict=True):
                shown = np.ascontiguousarray(frame[::step, ::step])
                container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, "rgb24")))
        for stream in streams:
            container.mux(stream.encode(None))
    assert count_frames(tmp_path / "two.mkv") == 5
    assert [frame.shape for _, frame in read_video(tmp_path / "two.mkv")] == [(32, 64, 3)] * 5
    assert read_frame(tmp_path / "two.mkv", 3).shape == (32, 64, 3)


@pytest.mark.parametrize(("size", "kind", "said"), [(32, 0, True), (24, 0, True), (16, 0, False), (32, 1024, False)])
def test_a_second_lens_is_said_a_preview_or_cover_not(tmp_path: Path, size: int, kind: int, said: bool, caplog) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "two.mp4"), "w") as container:
        for side, disposition in ((32, 1), (size, kind)):
            stream = container.add_stream("mjpeg", 10)
            stream.width, stream.height, stream.pix_fmt = 2 * side, side, "yuvj420p"
            stream.disposition = disposition
        for stream in container.streams.video:
            shown = np.zeros((stream.height, stream.width, 3), np.uint8)
            container.mux([*stream.encode(av.VideoFrame.from_ndarray(shown, "rgb24")), *stream.encode(None)])
    assert [number for number, _ in sharpest_frames(tmp_path / "two.mp4", 1, 1)] == [0]
    assert ("two.mp4 holds 2 videos; number 1 is used" in caplog.text) == said


@pytest.mark.parametrize("damaged", [[8], [0, 8, 16]])
def test_frames_after_a_damaged_one_are_left_out(tmp_path: Path, damaged: list[int], caplog) -> None:
    """Up to the next key frame, they repeat its errors; all are read if there are no others."""
    av = pytest.importorskip("av")
    noise = np.random.default_rng(0).integers(0, 256, (14, 30, 3)).astype(np.uint8)
    scene = np.array(Image.fromarray(noise).resize((300, 112), Image.Resampling.BICUBIC))
    path = tmp_path / "damaged.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", 10, {"g": "8", "bf": "0", "sc_threshold": "0"})
        stream.width, stream.height, stream.pix_fmt = 160, 112, "yuv444p"
        images = [av.VideoFrame.from_ndarray(scene[:, n : n + 160].copy(), "rgb24") for n in range(24)]
        packets = [packet for image in [*images, None] for packet in stream.encode(image)]
        for number, packet in enumerate(packets):
            if number in damaged:
                kept = packet.size // 4
                noise = np.random.default_rng(1).integers(0, 256, packet.size - kept).astype(np.uint8)
                packet.update(bytes(packet)[:kept] + noise.tobytes())
            container.mux(packet)
    found = {number: pixels() for number, pixels in sharpest_frames(path, 24, 8)}
    errors = [np.abs(pixels - scene[:, n : n + 160].astype(int)).mean() for n, pixels in found.items()]
    assert (max(errors) < 12) == (damaged == [8])
    if damaged == [8]:
        assert [number // 8 for number in found] == [0, 0, 0, 2, 2, 2]
    else:  # one of each interval; which one depends on what the decoder makes of the damage
        assert [number // 3 for number in found] == list(range(8))
    assert ("damaged.mkv is damaged: 8 of its frames" in caplog.text) == (damaged == [8])
    assert ("as no others are left" in caplog.text) == (damaged != [8])


@pytest.mark.parametrize(
    "content",
    [
        "ffconcat version 1.0\nfile bar.mp4\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\nbar.mp4\n#EXT-X-ENDLIST\n",
        "",
        None,  # the beginning of a video
    ],
)
def test_lists_and_damaged_files_are_refused(tmp_path: Path, content: str | None, monkeypatch) -> None:
    """A list under a video's name opens nothing of what it names."""
    pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    whole = write_video(tmp_path / "bar.mp4", _frames()).read_bytes()
    (tmp_path / "bad.mp4").write_bytes(whole[:100] if content is None else content.encode())
    for read in (count_frames, lambda path: list(read_video(path))):
        with pytest.raises(FormatError, match=r"bad.mp4"):
            read("bad.mp4")


def test_missing_decoder_names_the_remedy(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("vg2gt.io.video.importlib.util.find_spec", lambda name: None)
    (tmp_path / "clip.mp4").touch()
    for call in (lambda: count_frames(tmp_path / "clip.mp4"), lambda: write_video(tmp_path / "new.mp4", _frames())):
        with pytest.raises(ImportError, match=r"pip install 'vg2gt\[video\]'"):
            call()


def test_what_cannot_be_written_or_read(tmp_path: Path) -> None:
    for said, name, frames, fps in (
        ("at least one frame", "none.gif", [], 12),
        ("one size", "two.gif", [*_frames(1), *_frames(1, (16, 16))], 12),
        ("at least one frame", "none.mp4", [], 12),
        ("one size", "two.mp4", [*_frames(1), *_frames(1, (16, 16))], 12),
        ("fps", "still.gif", _frames(), 0),
        (r"\.gif or \.mp4", "film.avi", _frames(), 12),
    ):
        with pytest.raises(ValueError, match=said):
            write_video(tmp_path / name, frames, fps=fps)
    assert not list(tmp_path.iterdir())
    (tmp_path / "text.gif").write_text("no picture")
    with pytest.raises(FormatError, match="not a readable video"):
        list(read_video(tmp_path / "text.gif"))
    with pytest.raises(FileNotFoundError, match="no video"):
        count_frames(tmp_path / "nowhere.gif")
