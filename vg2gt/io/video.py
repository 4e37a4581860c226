"""Frames of videos, read by PyAV (FFmpeg's libraries), which the extra ``video`` installs."""

from __future__ import annotations

import importlib.util
import itertools
import logging
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.io.color import coded_to_srgb, needs_conversion
from vg2gt.io.errors import FormatError
from vg2gt.io.images import curvatures

if TYPE_CHECKING:
    from av import VideoCodecContext, VideoFrame  # optional
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

log = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".gif")
_UNSPECIFIED, BT709, _BT601 = 2, 1, 5  # matrices from YUV to RGB as PyAV numbers them
LIMITED = 1  # range of values of usual videos: 16 to 235
_EXACT = 0x4 | 0x2000 | 0x40000  # FFmpeg's scaler: bicubic, chroma for every pixel, accurate rounding
_SHARPNESS_SIDE = 640  # longer side of the frames that are compared, in pixels
_COMBED, _COMBED_IF_SAID = 1.1, 0.9  # difference of neighbouring rows by that of every second one
_PREVIEW, _COVER = 0.3, 0x400  # share of the used video's pixels that a preview has at most; FFmpeg's flag of covers
_STANDARD_LINES = 576  # rows of a video in standard definition, at most
_UNDECODABLE = "no frame of it can be decoded; it is truncated or damaged"
# Containers that hold all their frames. FFmpeg detects formats by content: a playlist under any name would make it open
# other files of this machine.
_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,flv,asf,ogg,gif"


def count_frames(path: str | Path) -> int:
    """Returns the number of frames of a video without decoding them.

    Raises:
        FormatError: if the file cannot be read.
        ImportError: if PyAV is not installed.
    """
    with _opened(path) as container:
        return sum(_shown(packet) for packet in container.demux(_stream(container)))


def read_video(path: str | Path, numbers: Container[int] | None = None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Decodes the frames of a video, turned upright by its display matrix and stretched to square pixels.

    Args:
        path: the file.
        numbers: numbers of the frames to yield, from 0; None: all.

    Yields:
        The frame number, from 0, and the pixels ``[H, W, 3]``.

    Raises:
        FormatError: if the file cannot be read.
        ImportError: if PyAV is not installed.
    """
    number = -1
    with _opened(path) as container:
        for number, (frame, _) in enumerate(_decoded(container)):
            if numbers is None or number in numbers:
                yield number, _upright(frame, _stream(container))
        if number < 0:
            raise FormatError(f"{path}: {_UNDECODABLE}")


def sharpest_frames(path: str | Path, count: int, limit: int) -> Iterator[tuple[int, Callable[[], NDArray[np.uint8]]]]:
    """Finds the sharpest frame of each of ``limit`` equal intervals of a video; decodes it once, one frame at a time.

    Frames are compared by their finest detail in the direction in which they have least, which motion blurs. Those from
    a damaged one to the next key frame are left out, unless all are.

    Args:
        path: the file.
        count: number of its frames (:func:`count_frames`).
        limit: number of intervals, at most ``count``.

    Yields:
        The frame number, from 0, and a function that returns the pixels ``[H, W, 3]`` before the next one is asked for.

    Raises:
        FormatError: if no frame can be decoded.
        ImportError: if PyAV is not installed.
    """
    damaged: set[int] = set()
    found: list[int] = []

    def numbered(container: InputContainer) -> Iterator[tuple[int, VideoFrame]]:
        for number, (frame, is_damaged) in enumerate(_decoded(container)):
            if is_damaged:
                damaged.add(number)
            yield number, frame

    with _opened(path) as container:
        _name_streams(path, container)
        for _, frames in itertools.groupby(numbered(container), lambda pair: min(pair[0] * limit // count, limit - 1)):
            number, sharpest = max(frames, key=lambda pair: (pair[0] not in damaged, _sharpness(pair[1])))
            found.append(number)
            if number not in damaged:
                yield number, lambda frame=sharpest: _upright(frame, _stream(container))
    if not found:
        raise FormatError(f"{path}: {_UNDECODABLE}")
    if damaged:
        log.warning(
            "%s is damaged: %d of its frames, up to the next key frame each, are %s", path, len(damaged),
            "used, as no others are left" if damaged.issuperset(found) else "left out",
        )  # fmt: skip
    if damaged.issuperset(found):
        for number, pixels in read_video(path, found):
            yield number, lambda pixels=pixels: pixels


def _sharpness(frame: VideoFrame) -> float:
    scale = min(1.0, _SHARPNESS_SIDE / max(frame.width, frame.height))
    width, height = (max(1, round(side * scale)) for side in (frame.width, frame.height))
    grey = frame.reformat(width, height, "gray").to_ndarray()
    return float(curvatures(grey.astype(np.float32)).min())


class VideoFrames:
    """Some frames of a video, decoded on demand; reading in order decodes each frame once."""

    def __init__(self, path: str | Path, numbers: Container[int]) -> None:
        self._path, self._numbers = path, numbers
        self._rest, self._number = read_video(path, numbers), -1
        self._pixels = np.zeros((0, 0, 3), np.uint8)

    def read(self, number: int) -> NDArray[np.uint8]:
        """Returns the pixels ``[H, W, 3]`` of frame ``number``, one of the given numbers.

        Raises:
            FormatError: if it cannot be decoded.
        """
        if number < self._number:
            self._rest, self._number = read_video(self._path, self._numbers), -1
        while self._number < number:
            found = next(self._rest, None)
            if found is None:
                raise FormatError(f"{self._path}: frame {number} cannot be decoded; the file is damaged")
            self._number, self._pixels = found
        return self._pixels


def read_frame(path: str | Path, number: int) -> NDArray[np.uint8]:
    """Decodes one frame ``[H, W, 3]`` of a video, starting at the last key frame before it.

    Raises:
        FormatError: if the file cannot be read or has no such frame.
        ImportError: if PyAV is not installed.
    """
    times = _frame_times(path, Path(path).stat().st_mtime_ns)
    if not 0 <= number < len(times):
        raise FormatError(f"{path} has {len(times)} frames, but frame {number} was requested")
    with _opened(path) as container:
        container.seek(times[number], stream=_stream(container))
        for frame, _ in _decoded(container):
            if frame.pts == times[number]:
                return _upright(frame, _stream(container))
    raise FormatError(f"{path}: frame {number} cannot be decoded; the file is damaged")


def video_size(path: str | Path) -> tuple[int, int]:
    """Returns ``(height, width)`` of a video's first frame, turned upright by its display matrix.

    Raises:
        FormatError: if the file cannot be read.
        ImportError: if PyAV is not installed.
    """
    height, width = read_frame(path, 0).shape[:2]
    return height, width


def _stream(container: InputContainer) -> VideoStream:
    """Returns the video stream that players show: files may have a preview or a cover before it."""
    return cast("VideoStream", container.streams.best("video"))


def _name_streams(path: str | Path, container: InputContainer) -> None:
    """Warns about further videos in a file, as of a second lens, but not about previews and covers."""
    used = _stream(container)
    large = [
        stream for stream in container.streams.video
        if stream.width * stream.height > _PREVIEW * used.width * used.height
        and not int(stream.disposition) & _COVER
    ]  # fmt: skip
    if len(large) > 1:
        log.warning(
            "%s holds %d videos; number %d is used, which players show: write each into a file of its own to use it",
            path, len(large), large.index(used) + 1,
        )  # fmt: skip


def _shown(packet: Packet) -> bool:
    """Returns whether a packet holds a frame to show: not the empty last one, nor what a trimmed video skips."""
    return packet.size > 0 and not packet.is_discard


@lru_cache(maxsize=8)
def _frame_times(path: str | Path, state: int) -> list[int]:
    """Sorted presentation times of all frames; a new ``state`` invalidates the cache when the file changes."""
    with _opened(path) as container:
        return sorted(
            packet.pts for packet in container.demux(_stream(container)) if _shown(packet) and packet.pts is not None
        )


def require_pyav(purpose: str) -> None:
    """Checks early that PyAV is installed.

    Raises:
        ImportError: if it is not, naming the purpose and the remedy.
    """
    if importlib.util.find_spec("av") is None:
        raise ImportError(f"{purpose} needs PyAV: pip install 'vg2gt[video]'")


@contextmanager
def _opened(path: str | Path) -> Iterator[InputContainer]:
    """Opens a video file, but no other files that it refers to."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no video at {path}")
    require_pyav(f"reading {path}")
    import av
    from av.error import FFmpegError

    try:
        with open(path, "rb") as file, av.open(file, container_options={"format_whitelist": _CONTAINERS}) as container:
            if not container.streams.video:
                raise FormatError(f"{path}: it contains no video stream; use a video file")
            yield container
    except (FFmpegError, OSError) as error:
        raise FormatError(f"{path}: not a readable video ({error.strerror}); it is damaged or a playlist") from error


def _decoded(container: InputContainer) -> Iterator[tuple[VideoFrame, bool]]:
    """Decodes the frames of the video stream; damaged packets are skipped.

    Yields:
        A frame, and whether it is damaged: frames that follow a damaged one repeat its errors up to a key frame.
    """
    from av.error import InvalidDataError

    _stream(container).thread_type = "AUTO"
    damaged = False
    for packet in container.demux(_stream(container)):
        try:
            frames = packet.decode()
        except InvalidDataError:
            damaged = True
            continue
        for frame in frames:
            damaged = frame.is_corrupt or (damaged and not frame.key_frame)
            yield frame, damaged


def _pixels(frame: VideoFrame, context: VideoCodecContext) -> NDArray[np.uint8]:
    """Converts a frame of any colour format to sRGB ``[H, W, 3]``, HLG and PQ by their transfer functions.

    Two half images of different times, as of interlaced videos, become the first one with its missing rows filled in.
    """
    interlaced = _is_combed(frame)
    lines = frame.height
    if interlaced:
        frame = _first_field(frame)
    primaries, transfer = int(context.color_primaries), int(context.color_trc)
    untagged = frame.colorspace == _UNSPECIFIED and "yuv" in frame.format.name
    # as players do: BT.709 in high definition, else BT.601
    matrix = (BT709 if lines > _STANDARD_LINES else _BT601) if untagged else None
    if not needs_conversion(primaries, transfer):
        shown = frame.reformat(format="rgb24", interpolation=_EXACT, src_colorspace=matrix)
        pixels = shown.to_ndarray().astype(np.uint8, copy=False)
    else:
        deep = frame.reformat(format="rgb48le", interpolation=_EXACT, src_colorspace=matrix)
        pixels = coded_to_srgb(deep.to_ndarray(), primaries, transfer)
    return _all_rows(pixels, lines) if interlaced else pixels


def _is_combed(frame: VideoFrame) -> bool:
    """Returns whether neighbouring rows differ as much as every second one: each second row is of another time.

    In photographs they differ by .5 to .8 of that; a file that calls itself interlaced needs less evidence.
    """
    rows = frame.reformat(format="gray").to_ndarray().astype(np.float32)
    near, far = (float(np.abs(rows[step:] - rows[:-step]).mean()) for step in (1, 2)) if len(rows) > 2 else (0.0, 0.0)
    return near > (_COMBED_IF_SAID if frame.interlaced_frame else _COMBED) * far


def _first_field(frame: VideoFrame) -> VideoFrame:
    """Returns every second row of a frame, from the first; also of its chroma, which belongs to the same rows."""
    from av.filter import Graph

    graph = Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 25)
    )
    graph.link_nodes(source, graph.add("field", "type=top"), graph.add("buffersink")).configure()
    graph.vpush(frame)
    return graph.vpull()


def _all_rows(field: NDArray[np.uint8], lines: int) -> NDArray[np.uint8]:
    """Fills in the rows between those of a field by cubic interpolation; returns ``[lines, W, 3]``."""
    rows = np.pad(field.astype(np.float32), ((1, 2), (0, 0), (0, 0)), "edge")
    between = (9 * (rows[1:-2] + rows[2:-1]) - rows[:-3] - rows[3:]) / 16
    return np.stack([field, between.round().clip(0, 255).astype(np.uint8)], 1).reshape(-1, *field.shape[1:])[:lines]


def _upright(frame: VideoFrame, stream: VideoStream) -> NDArray[np.uint8]:
    """Converts a frame to sRGB ``[H, W, 3]`` of square pixels, rotated and mirrored by its display matrix."""
    pixels = _squared(_pixels(frame, stream.codec_context), float(stream.sample_aspect_ratio or 1))
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return pixels
    # pixel (x right, y down) is shown at (a x + c y, b x + d y)
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].tolist()
    if abs(b) > abs(a):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return np.ascontiguousarray(pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _squared(pixels: NDArray[np.uint8], aspect: float) -> NDArray[np.uint8]:
    """Enlarges an image whose pixels are ``aspect`` times as wide as high, as of DV, HDV and anamorphic lenses."""
    height, width = pixels.shape[:2]
    size = (round(width * max(aspect, 1)), round(height * max(1 / aspect, 1)))
    return pixels if size == (width, height) else np.asarray(Image.fromarray(pixels).resize(size))
