"""Animations of rendered views: MP4 by PyAV (:mod:`vg2gt.io.video`), GIF by Pillow."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.io.files import replacing, write_bytes
from vg2gt.io.video import BT709, LIMITED, require_pyav

_QUALITY = "18"  # constant rate factor of H.264: 0 is lossless, 23 is x264's default
_PALETTE = 255


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float = 24.0) -> Path:
    """Writes an animation for browsers (:func:`video_writer`); returns its path."""
    with video_writer(path, fps) as add:
        for pixels in frames:
            add(pixels)
    return Path(path)


@contextmanager
def video_writer(path: str | Path, fps: float = 24.0) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Writes an animation frame by frame, atomically: a looping GIF, or H.264 in MP4.

    Args:
        path: the file, ``.gif`` or ``.mp4``.
        fps: frames per second; GIF rounds frame durations to 1/100 s, at least 1/50 s.

    Yields:
        A function that takes a frame, uint8 ``[H, W, 3]``, all of one size; it is not changed. MP4 needs even sizes:
        an odd last row or column is cropped. A GIF is kept in memory until the end, which an MP4 is not.

    Raises:
        ValueError: if there are no frames, sizes differ, ``fps`` is not positive, or the suffix is unknown.
        ImportError: if it is an MP4 and PyAV is not installed.
    """
    path = Path(path)
    encoders = {".gif": _gif_encoder, ".mp4": _mp4_encoder}
    if not 0 < fps < math.inf:
        raise ValueError(f"fps must be positive, got {fps}")
    if path.suffix.lower() not in encoders:
        raise ValueError(f"{path}: animations are written as .gif or .mp4")
    shapes: set[tuple[int, ...]] = set()
    with encoders[path.suffix.lower()](path, fps) as encode:

        def add(pixels: NDArray[np.uint8]) -> None:
            shapes.add(pixels.shape)
            if len(shapes) > 1 or pixels.dtype != np.uint8:
                raise ValueError(f"{path}: frames must be uint8 [H, W, 3] of one size, got {sorted(shapes)}")
            encode(pixels)

        yield add
        if not shapes:
            raise ValueError(f"{path}: expected at least one frame, got none")


@contextmanager
def _gif_encoder(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    frames: list[NDArray[np.uint8]] = []
    yield frames.append
    if frames:
        write_bytes(path, _gif(frames, fps))


def _gif(frames: Sequence[NDArray[np.uint8]], fps: float) -> bytes:
    """Encodes a GIF with one palette from the whole animation, so that colours do not flicker."""
    step = max(1, len(frames) // 8)
    sample = np.concatenate([frame[::2, ::2] for frame in frames[::step]])
    palette = Image.fromarray(np.ascontiguousarray(sample)).quantize(_PALETTE, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(np.ascontiguousarray(frame)).quantize(palette=palette) for frame in frames]
    buffer = io.BytesIO()
    duration = max(20, round(100 / fps) * 10)
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)
    return buffer.getvalue()


@contextmanager
def _mp4_encoder(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    require_pyav(f"writing {path.name}")
    import av
    from av.error import FFmpegError

    with replacing(path) as temporary:
        try:
            with av.open(f"file:{temporary}", "w", format="mp4", options={"movflags": "+faststart"}) as container:
                # x264's macroblock tree is not deterministic, even on one thread
                options = {"crf": _QUALITY, "x264-params": "mbtree=0"}
                stream = container.add_stream("libx264", Fraction(f"{fps:g}"), options)
                stream.pix_fmt = "yuv420p"
                context = stream.codec_context
                context.colorspace = context.color_primaries = context.color_trc = BT709
                context.color_range = LIMITED
                context.thread_count = 1  # several threads are not deterministic

                def encode(pixels: NDArray[np.uint8]) -> None:
                    height, width = (side // 2 * 2 for side in pixels.shape[:2])
                    if not context.is_open:
                        stream.width, stream.height = width, height
                    even = np.ascontiguousarray(pixels[:height, :width])
                    frame = av.VideoFrame.from_ndarray(even, "rgb24")
                    coded = frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED)
                    container.mux(stream.encode(coded))

                yield encode
                container.mux(stream.encode(None))
        except FFmpegError as error:
            raise OSError(error.errno, error.strerror) from error
