"""Decoding of colour and depth image files.

Functions that take a scene raise ``DataError``, naming file and scene, if a file is missing, damaged or of the wrong
kind.
"""

from __future__ import annotations

import io
import math
import statistics
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import TiffImageFile

from vg2gt.io.errors import DataError
from vg2gt.io.images import color_image, has_alpha, open_image

# Errors that Pillow raises for damaged files.
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, zlib.error, struct.error, Image.DecompressionBombError)

Size = tuple[int, int]
"""Height and width in pixels."""

_ORIENTATION_TAG = 0x0112
_UPRIGHT = ("FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE", "ROTATE_270", "TRANSVERSE", "ROTATE_90")
_TURNS = {number: Image.Transpose[name] for number, name in enumerate(_UPRIGHT, 2)}  # by EXIF orientation
_QUARTER_TURNS = (5, 6, 7, 8)
_BACK = {6: 8, 8: 6}  # orientations that undo others; the rest undo themselves
_LARGE = 24_000_000  # pixels; larger images are decoded at reduced size where that suffices
_DRAFT = 8  # largest reduction by the decoder
_SAME_SHAPE = 0.02  # relative difference of aspect ratios of the same shape
_START_OF_SCAN = 0xDA  # marker of JPEG
_ZEROS = 64  # bytes at the end of a file that was cut off
_FILM_DIAGONAL = math.hypot(36, 24)  # millimetres


def image_size(path: Path, scene: str, upright: bool = False, content: bytes | None = None) -> Size:
    """Returns an image's ``(height, width)`` without decoding it.

    Args:
        path: the file.
        scene: the scene it belongs to, for messages; empty: none.
        upright: size after turning a photograph upright by its EXIF orientation.
        content: the encoded image if it is a part of the file; None: the whole file.
    """
    with _opened(path, scene, content) as image:
        return _size(image, upright)


def is_damaged(path: Path) -> bool:
    """Whether a file cannot be opened as an image; nothing is decoded."""
    try:
        image_size(path, "")
    except DataError:
        return True
    return False


def frame_count(path: Path) -> int:
    """Returns the number of pictures in an image file, such as the pages of a TIFF; 1 if it cannot be told."""
    try:
        with _opened(path, "") as image:
            return int(getattr(image, "n_frames", 1))
    except (DataError, *_DAMAGED):
        return 1


def focal_length(path: Path, size: Size) -> float | None:
    """Returns the focal length of a photograph in pixels, from the 35 mm equivalent in its EXIF data.

    Args:
        path: the file.
        size: ``(height, width)`` of the image.

    Returns:
        The focal length; None if it is missing or not plausible, or the photograph had another aspect ratio: of a crop,
        the focal length of the whole tells nothing.
    """
    try:
        with open_image(path) as image:
            exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
        film = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
        width, height = (int(exif.get(tag, 0)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight))
    except Exception:  # damaged EXIF data raise various errors
        return None
    if min(width, height) > 0 and not same_shape(size, (height, width)) and not same_shape(size, (width, height)):
        return None
    return film * math.hypot(*size) / _FILM_DIAGONAL if 4 <= film <= 2000 else None


def gps_position(path: Path) -> tuple[float, float, float] | None:
    """Returns where a photograph was taken, from its EXIF data.

    Returns:
        Latitude and longitude in degrees (north and east are positive) and altitude in metres, NaN if that is unknown;
        None if the others are.
    """
    tags = ExifTags.GPS
    try:
        with open_image(path) as image:
            gps = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude, longitude = (
            sum(float(part) / 60**power for power, part in enumerate(gps[angle])) * signs[_letter(gps[side])]
            for angle, side, signs in (
                (tags.GPSLatitude, tags.GPSLatitudeRef, {"N": 1, "S": -1}),
                (tags.GPSLongitude, tags.GPSLongitudeRef, {"E": 1, "W": -1}),
            )
        )
        is_below = gps.get(tags.GPSAltitudeRef, b"\0") in (b"\1", 1, 3)
        altitude = float(gps.get(tags.GPSAltitude, math.nan)) * (-1 if is_below else 1)
    except Exception:  # damaged EXIF data raise various errors
        return None
    is_sound = abs(latitude) <= 90 and abs(longitude) <= 180 and not math.isinf(altitude)
    return (latitude, longitude, altitude) if is_sound and (latitude or longitude) else None  # 0, 0: no position


def _letter(reference: str | bytes) -> str:
    """Returns the first letter of a reference such as ``N``, which some programs pad, spell out or write small."""
    text = reference.decode("ascii") if isinstance(reference, bytes) else reference
    return text.strip(" \0")[:1].upper()


def typical_size(sizes: Iterable[Size]) -> Size:
    """Returns a common ``(height, width)`` for images of several sizes: the lower median of each."""
    heights, widths = zip(*sizes, strict=True)
    return statistics.median_low(heights), statistics.median_low(widths)


def read_color(
    path: Path,
    scene: str,
    size: Size | None = None,
    content: bytes | None = None,
    upright: bool = False,
    least: Size | None = None,
) -> NDArray[np.uint8]:
    """Reads a colour image ``[H, W, 3]``.

    Args:
        path: the file.
        scene: the scene it belongs to, for messages; empty: none.
        size: required ``(height, width)``; None: any.
        content: the encoded image if it is a part of the file; None: the whole file.
        upright: turn a photograph upright by its EXIF orientation.
        least: ``(height, width)`` that suffices. Large images are decoded at a half, quarter or eighth of their size if
            that is at least twice as large; the whole of the image is kept, to fractions of a pixel. None: full size.
    """
    with _opened(path, scene, content) as image:
        found = _size(image, upright)
        check_size(path, scene, found, size)  # before anything is decoded
        turn = _turn(image, upright)
        factor = 1 if least is None else _reduction(found, least)
        return np.array(_turned(color_image(image if factor == 1 else _reduced(image, factor)), turn))


def _reduction(size: Size, least: Size) -> int:
    """Returns the factor by which an image of ``(height, width)`` is reduced while it is decoded: 1, 2, 4 or 8."""
    factor = min(size[0] // least[0], size[1] // least[1]) // 2
    if factor < _DRAFT and size[0] * size[1] <= _LARGE:
        return 1
    return max(step for step in (1, 2, 4, _DRAFT) if step <= max(factor, 1))


def _reduced(image: Image.Image, factor: int) -> Image.Image:
    """Returns an image reduced by a factor, by the decoder if it is a JPEG; unchanged if its mode allows neither."""
    width, height = image.size
    target = (round(width / factor), round(height / factor))
    if image.format in ("JPEG", "MPO"):
        image.draft(image.mode, (width // factor, height // factor))
        if image.size == (width, height):
            return image
        small = image
    elif image.mode in ("RGB", "RGBA", "L", "LA", "CMYK"):
        small = image.reduce(factor)
    else:
        return image
    if small.size != target or width % factor or height % factor:  # the last block of a row or column is incomplete
        small = small.resize(target, Image.Resampling.BILINEAR, (0, 0, width / factor, height / factor))
    # what the conversion of colours looks at
    small.info, small.format, small.filename = image.info, image.format, getattr(image, "filename", "")  # pyright: ignore
    return small


def read_mask(
    path: Path, scene: str, content: bytes | None = None, upright: bool = False, is_mask: bool = False
) -> NDArray[np.float32] | None:
    """Reads a mask ``[H, W]`` in [0, 1]: an image's alpha, or the brightness of a mask image without alpha.

    Args:
        path: the file.
        scene: the scene it belongs to, for messages; empty: none.
        content: the encoded image if it is a part of the file; None: the whole file.
        upright: turn a photograph upright by its EXIF orientation.
        is_mask: the file is a mask, so its brightness counts; values 0 and 1 are taken as 0 and 255, and
            all colours of a palette but black as 255.

    Returns:
        The mask; None if all pixels count, as in a photograph without transparency.
    """
    with _opened(path, scene, content) as image:
        turn = _turn(image, upright)
        grey, labels = not has_alpha(image), is_mask and _has_labels(image)
        if grey and not is_mask:
            return None
        if is_mask and not grey and np.asarray(image.convert("RGBA").getchannel("A")).min(initial=255) == 255:
            image, grey = image.convert("RGB"), True  # an opaque alpha says nothing
        if grey:
            plane = image if image.mode in ("I", "I;16") else image.convert("L")
        else:
            plane = image.convert("RGBA").getchannel("A")
        values = np.array(_turned(plane, turn), np.float32)
    highest = values.max(initial=0)
    if labels:
        values, highest = 255 * (values > 0), 255.0
    largest = 1 if grey and highest == 1 else 255 if highest <= 255 else 65535
    return None if values.min(initial=largest) >= largest else (values / largest).astype(np.float32)


def _has_labels(image: Image.Image) -> bool:
    """Returns whether an image has a palette with colours, which stand for labels and can be dark."""
    colors = np.asarray(image.convert("RGB")) if image.mode == "P" else np.zeros((1, 1, 3))
    return bool((colors != colors[..., :1]).any())


def read_mask_file(path: Path, scene: str, photo: Path, upright: bool = False) -> NDArray[np.float32] | None:
    """Reads the mask file of an image (:func:`read_mask`); None: all pixels count.

    Args:
        path: the mask.
        scene: the scene it belongs to, for messages; empty: none.
        photo: the image.
        upright: whether the image is turned upright. A mask with the shape of the stored pixels, rather than of the
            upright photograph, is turned along with it.

    Raises:
        DataError: if it cannot be read, or has another shape than the image.
    """
    try:
        mask = read_mask(path, scene, upright=upright, is_mask=True)
    except DataError as error:
        raise DataError(str(error)) from None  # the reason alone would not say that it is the mask
    if mask is None:
        return None
    with _opened(photo, scene) as image:
        turn, stored, turned = _orientation(image), _size(image, False), _size(image, upright)
    if same_shape(mask.shape, turned):
        return mask
    if same_shape(mask.shape, stored):
        return np.array(_turned(Image.fromarray(mask), turn))
    raise DataError(
        f"the mask {path} is {mask.shape[1]}x{mask.shape[0]} pixels, but its image {photo} is {turned[1]}x{turned[0]}: "
        "make it from the whole image"
    )


def same_shape(one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Returns whether an image of one ``(height, width)`` can be one of the other resized, rounded to whole pixels."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) < max(_SAME_SHAPE, 2 / min(*one, *other))


def orientation(path: Path, scene: str) -> int:
    """Returns the EXIF orientation of an image; 1 (upright) if it has none."""
    with _opened(path, scene) as image:
        return _orientation(image)


def read_depth(path: Path, scene: str, size: Size | None = None) -> NDArray[np.int64]:
    """Reads a one-channel integer depth image ``[H, W]`` as stored (16-bit PNG, PGM or TIFF)."""
    with _opened(path, scene) as image:
        channels = len(image.getbands())
        if channels == 1:
            check_size(path, scene, image.size[::-1], size)
        pixels = np.array(image)
    if pixels.ndim != 2 or pixels.dtype.kind not in "iu":
        found = f"{pixels.dtype} values of shape {pixels.shape}"
        raise DataError(f"{path} of scene {scene} is not a depth image of one channel of integers, but {found}")
    return pixels.astype(np.int64)


def check_size(path: Path, scene: str, found: tuple[int, ...], expected: Size | None) -> None:
    """Raises ``DataError`` if an image's ``(height, width)`` is not the expected one; None: any."""
    if expected is not None and tuple(found) != tuple(expected):
        raise DataError(
            f"{path} of scene {scene} is {found[1]}x{found[0]} pixels, but the recording's first one is "
            f"{expected[1]}x{expected[0]}"
        )


@contextmanager
def _opened(path: Path, scene: str, content: bytes | None = None) -> Iterator[Image.Image]:
    """Opens an image; errors while it is read become ``DataError`` with the file, the scene and a remedy."""
    try:
        with open_image(path if content is None else io.BytesIO(content)) as image:
            if image.format in ("JPEG", "MPO") and content is None:
                _check_end(path)
            yield image
    except DataError:
        raise
    except _DAMAGED as error:
        whose, remedy = (f" of scene {scene}", "remove the frame") if scene else ("", "leave it out")
        raise DataError(f"cannot read {path}{whose}: {error}; restore the file or {remedy}") from error


def _check_end(path: Path) -> None:
    """Checks that a JPEG file does not break off in zeros, as an interrupted copy does: decoders fill it with grey.

    Raises:
        OSError: if it does.
    """
    with path.open("rb") as file:
        file.seek(-min(_ZEROS, path.stat().st_size), io.SEEK_END)
        if any(file.read()):
            return
        file.seek(0)
        data = file.read()
    place = 2
    while data[place : place + 1] == b"\xff" and data[place + 1] != _START_OF_SCAN:  # segments, with their length
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    if b"\xff\xd9" not in data[place:]:
        raise OSError("the end of the file is zeros: it was not copied as a whole")


def _turned(picture: Image.Image, orientation: int) -> Image.Image:
    """Turns an image of an EXIF orientation upright."""
    return picture.transpose(_TURNS[orientation]) if orientation in _TURNS else picture


def _turn(image: Image.Image, upright: bool) -> int:
    """Returns the orientation to undo once an image is decoded; Pillow turns TIFF files upright itself."""
    orientation = _orientation(image)
    if isinstance(image, TiffImageFile):
        return 1 if upright else _BACK.get(orientation, orientation)
    return orientation if upright else 1


def _size(image: Image.Image, upright: bool) -> Size:
    height, width = image.height, image.width
    if isinstance(image, TiffImageFile):  # Pillow's size is the stored or, from version 11 on, the upright one
        width, height = (int(image.tag_v2[tag]) for tag in (ExifTags.Base.ImageWidth, ExifTags.Base.ImageLength))
    turned = upright and _orientation(image) in _QUARTER_TURNS
    return (width, height) if turned else (height, width)


def _orientation(image: Image.Image) -> int:
    """EXIF orientation of an image; 1 (upright) if it is missing or damaged."""
    try:
        return int(image.getexif().get(_ORIENTATION_TAG, 1))
    except Exception:  # damaged EXIF data raise various errors
        return 1
