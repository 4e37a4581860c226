"""Moving pictures: frames of videos, and animations of rendered views.

GIF goes through Pillow and always works. Everything else goes through the program ``ffmpeg``: the system's, or the one
that the extra ``video`` brings (``pip install vg2gt[video]``).

Example:
    >>> import numpy as np, tempfile
    >>> from vg2gt.io import read_video, write_video
    >>> frames = [np.full((16, 24, 3), shade, np.uint8) for shade in (0, 128, 255)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_video(folder + "/shades.gif", frames, fps=10)
    ...     [(number, frame.shape) for number, frame in read_video(path, every=2)]
    [(0, (16, 24, 3)), (2, (16, 24, 3))]
"""

from __future__ import annotations

import importlib.util
import io
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_bytes
from vg2gt.io.images import open_image

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".gif")
_QUALITY = "18"  # constant rate factor of H.264: 0 is lossless, 23 the program's default
_PALETTE = 255


class MissingDecoderError(RuntimeError):
    """There is no ffmpeg; the message says how to get one."""


def count_frames(path: str | Path) -> int:
    """Number of frames of a video, without decoding them.

    Raises:
        FormatError: if the file cannot be read.
        MissingDecoderError: if it is no GIF and there is no ffmpeg.
    """
    path = _existing(path)
    if path.suffix.lower() == ".gif":
        with _open_gif(path) as image:
            return getattr(image, "n_frames", 1)
    done = _run(["-i", str(path), "-map", "0:v:0", "-c", "copy", "-f", "null", "-"])
    counts = re.findall(rb"frame=\s*(\d+)", done.stderr)
    if done.returncode or not counts:
        raise FormatError(f"{path}: ffmpeg cannot read it ({_last_line(done.stderr)})")
    return int(counts[-1])


def read_video(path: str | Path, every: int = 1) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Decodes every so many frames of a video, turned upright as the file says.

    Args:
        path: the file.
        every: 1 for every frame.

    Yields:
        The frame's number, from 0, and its pixels ``[H, W, 3]``.

    Raises:
        FormatError: if the file cannot be read.
        MissingDecoderError: if it is no GIF and there is no ffmpeg.
    """
    path = _existing(path)
    if path.suffix.lower() == ".gif":
        yield from _read_gif(path, every)
        return
    # Frames are numbered anew, or the chosen ones would be repeated to fill the time between them.
    choose = f"select=not(mod(n\\,{every})),setpts=N/FRAME_RATE/TB"
    command = [_ffmpeg(), "-v", "error", "-i", str(path), "-map", "0:v:0", "-vf", choose]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            [*command, "-f", "image2pipe", "-c:v", "ppm", "-"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=complaints,
        )
        assert process.stdout is not None
        number = 0
        try:
            while (frame := _read_ppm(process.stdout)) is not None:
                yield number, frame
                number += every
        finally:
            process.stdout.close()
            process.kill() if process.poll() is None and number else None
            process.wait()
        if not number:
            complaints.seek(0)
            raise FormatError(f"{path}: ffmpeg decodes no frame ({_last_line(complaints.read())})")


def write_video(path: str | Path, frames: Sequence[NDArray[np.uint8]], fps: float = 24.0) -> Path:
    """Writes an animation that a browser plays, atomically: GIF (endless), or H.264 in MP4.

    Args:
        path: the file, ``.gif`` or ``.mp4``.
        frames: ``[H, W, 3]`` each, all of one size; not changed. MP4 needs even sizes: an odd row or column is cut.
        fps: frames a second; GIF knows hundredths of a second only.

    Returns:
        The path.

    Raises:
        ValueError: if there are no frames, sizes differ, or the suffix is another.
        MissingDecoderError: if it is an MP4 and there is no ffmpeg.
    """
    path = Path(path)
    if not len(frames) or any(f.shape != frames[0].shape or f.dtype != np.uint8 for f in frames):
        raise ValueError(f"expected at least one frame, all uint8 [H, W, 3] of one size, got {len(frames)}")
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    if path.suffix.lower() == ".gif":
        return write_bytes(path, _gif(frames, fps))
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: animations are written as .gif or .mp4")
    return _write_mp4(path, frames, fps)


def has_ffmpeg() -> bool:
    """Whether anything but GIF can be read and written."""
    return shutil.which("ffmpeg") is not None or importlib.util.find_spec("imageio_ffmpeg") is not None


def require_ffmpeg(purpose: str) -> None:
    """Checks early that there is an ffmpeg.

    Raises:
        MissingDecoderError: if there is none, naming the purpose and the remedy.
    """
    if not has_ffmpeg():
        raise MissingDecoderError(
            f"{purpose} needs ffmpeg: pip install 'vg2gt[video]', or install the system's ffmpeg (GIF works without)"
        )


def _ffmpeg() -> str:
    require_ffmpeg("a video other than GIF")
    found = shutil.which("ffmpeg")
    if found is None:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

        found = imageio_ffmpeg.get_ffmpeg_exe()
    return str(found)


def _run(arguments: list[str]) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([_ffmpeg(), *arguments], stdin=subprocess.DEVNULL, capture_output=True, check=False)


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no video at {path}")
    return path


def _last_line(text: bytes) -> str:
    lines = text.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it says nothing"


def _open_gif(path: Path) -> Image.Image:
    try:
        return open_image(path)
    except Exception as error:  # Pillow raises whatever the bytes lead it to
        raise FormatError(f"{path}: not a GIF ({error})") from error


def _read_gif(path: Path, every: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    with _open_gif(path) as image:
        for number in range(0, getattr(image, "n_frames", 1), every):
            try:
                image.seek(number)
                yield number, np.array(image.convert("RGB"))
            except Exception as error:  # Pillow raises whatever the bytes lead it to
                raise FormatError(f"{path}: frame {number} is damaged ({error})") from error


def _read_ppm(stream: io.BufferedIOBase | io.RawIOBase | object) -> NDArray[np.uint8] | None:
    """The next image of a stream of binary PPM files; None at its end."""
    read = stream.read  # pyright: ignore[reportAttributeAccessIssue]
    if read(2) != b"P6":
        return None
    numbers: list[int] = []
    digits = b""
    read(1)
    while len(numbers) < 3:  # width, height, largest value, each followed by one blank
        byte = read(1)
        if byte.isdigit():
            digits += byte
        else:
            numbers.append(int(digits))
            digits = b""
    width, height, _ = numbers
    content = read(width * height * 3)
    if len(content) < width * height * 3:
        return None
    return np.frombuffer(content, np.uint8).reshape(height, width, 3)


def _gif(frames: Sequence[NDArray[np.uint8]], fps: float) -> bytes:
    """One palette for all frames, from the whole animation, so that colours do not flicker."""
    step = max(1, len(frames) // 8)
    sample = np.concatenate([frame[::2, ::2] for frame in frames[::step]])
    palette = Image.fromarray(np.ascontiguousarray(sample)).quantize(_PALETTE, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(np.ascontiguousarray(frame)).quantize(palette=palette) for frame in frames]
    buffer = io.BytesIO()
    duration = max(20, round(100 / fps) * 10)
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)
    return buffer.getvalue()


def _write_mp4(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> Path:
    height, width = frames[0].shape[0] // 2 * 2, frames[0].shape[1] // 2 * 2
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    codec = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", _QUALITY, "-movflags", "+faststart"]
    pixels = b"".join(np.ascontiguousarray(frame[:height, :width]).tobytes() for frame in frames)
    try:
        done = subprocess.run(
            [_ffmpeg(), "-v", "error", "-y", *source, *codec, str(temporary)],
            input=pixels,
            capture_output=True,
            check=False,
        )
        if done.returncode:
            raise OSError(f"{path}: ffmpeg could not write it ({_last_line(done.stderr)})")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
