"""Images: reading, colours for depth and normals, grids of panels, PNG files."""

from __future__ import annotations

import importlib.util
import io
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from vg2gt.io.color import to_srgb
from vg2gt.io.files import regular, write_bytes

# Anchors of a perceptually ordered colour map, near (bright) to far (dark); interpolated linearly.
_DEPTH_ANCHORS = torch.tensor(
    [
        [0.99, 0.91, 0.55],
        [0.97, 0.60, 0.32],
        [0.83, 0.28, 0.40],
        [0.50, 0.15, 0.50],
        [0.20, 0.07, 0.38],
        [0.02, 0.02, 0.10],
    ]
)


BACKGROUND = (255, 255, 255, 255)  # behind transparent pixels

# Pillow tries all formats, whatever the suffix, and some of them run other programs (EPS: Ghostscript).
_FORMATS = ("PNG", "JPEG", "MPO", "PPM", "TIFF", "WEBP", "BMP", "GIF", "HEIF", "AVIF")


_HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")  # brands; AVIF has avif

MOST_PIXELS = 300_000_000  # of an image; Pillow's own limit is 179 million
_opening = threading.Lock()


def open_image(file: str | Path | IO[bytes]) -> Image.Image:
    """Opens an image file lazily with Pillow, restricted to formats of photographs and depth images.

    Raises:
        ImportError: if it is HEIC, under any name, and pillow-heif is not installed.
        OSError: if the file is missing, empty, not a regular file, of another format, or of more than 300 megapixels.
    """
    if isinstance(file, (str, Path)):
        regular(file)
        if not Path(file).stat().st_size:
            raise OSError("the file is empty")
        _allow_heic(Path(file))
    Image.init()
    with _opening:  # Pillow's limit is global
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            image = Image.open(file, formats=[name for name in _FORMATS if name in Image.OPEN])
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    if image.width * image.height > MOST_PIXELS:
        image.close()
        raise OSError(
            f"it has {image.width}x{image.height} pixels, more than {MOST_PIXELS // 10**6} million: reduce it"
        )
    return image


def _allow_heic(path: Path) -> None:
    """Makes Pillow read HEIC if the file is one by its content: phones and clouds also name it ``.jpg``."""
    with path.open("rb") as stream:
        head = stream.read(12)
    if head[4:8] != b"ftyp" or head[8:] not in _HEIC:
        return
    if importlib.util.find_spec("pillow_heif") is None:
        raise ImportError(f"{path} is HEIC: pip install pillow-heif, or save it as JPEG")
    from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports]

    register_heif_opener()


def has_alpha(image: Image.Image) -> bool:
    """Whether an image has transparency; nothing is decoded."""
    return "A" in image.getbands() or "a" in image.getbands() or "transparency" in image.info


def color_image(image: Image.Image) -> Image.Image:
    """Converts a photograph to 8-bit sRGB.

    Colour profiles are applied (:mod:`vg2gt.io.color`). 16-bit grey is scaled; Pillow's own conversion would clip it at
    255. Transparency is composited over white, as is usual for synthetic datasets.

    Raises:
        OSError: if the range of values is unknown: 32-bit integers and floats.
    """
    grey = image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM"))
    if grey:
        info = image.info
        image = Image.fromarray((np.asarray(image, np.float32) / 257 + 0.5).astype(np.uint8))
        image.info = info
    elif image.mode in ("I", "F"):
        kind = "32-bit integers" if image.mode == "I" else "floating-point numbers"
        raise OSError(f"the value range of a photograph of {kind} is unknown: save it with 8 or 16 bits per channel")
    if has_alpha(image):
        alpha = image.convert("RGBA").getchannel("A")
        image = to_srgb(image).convert("RGBA")
        image.putalpha(alpha)
        return Image.alpha_composite(Image.new("RGBA", image.size, BACKGROUND), image).convert("RGB")
    return to_srgb(image).convert("RGB")


def colorize_depth(depth: Tensor, near: float, far: float) -> Tensor:
    """Colours z-depth ``[H, W]`` between ``near`` (bright) and ``far`` (dark), ``[3, H, W]``; 0 and NaN are grey."""
    position = ((depth - near) / max(far - near, 1e-9)).clamp(0, 1) * (len(_DEPTH_ANCHORS) - 1)
    index = position.nan_to_num(0.0).long().clamp(max=len(_DEPTH_ANCHORS) - 2)
    anchors = _DEPTH_ANCHORS.to(depth.device)
    colors = torch.lerp(anchors[index], anchors[index + 1], (position - index)[..., None])
    colors[~(depth > 0)] = 0.5
    return colors.permute(2, 0, 1)


def colorize_normals(normals: Tensor) -> Tensor:
    """Colours camera-frame normals ``[3, H, W]`` (x right, y down, z forward) in OpenGL axes; zero normals are grey."""
    unit = torch.nn.functional.normalize(normals, dim=0)
    flipped = unit * unit.new_tensor([1.0, -1.0, -1.0])[:, None, None]
    return (flipped + 1) / 2


def grid(rows: Sequence[Sequence[Tensor]], gap: int = 4) -> Tensor:
    """Arranges panels ``[3, H, W]`` of equal size in rows with white gaps; returns ``[3, H', W']``."""
    lines = []
    for row in rows:
        padded = [torch.nn.functional.pad(panel, (0, gap, 0, gap), value=1.0) for panel in row]
        lines.append(torch.cat(padded, -1))
    return torch.cat(lines, -2)[..., :-gap, :-gap]


def to_pixels(image: Tensor) -> NDArray[np.uint8]:
    """Converts an image ``[3, H, W]`` in [0, 1] to ``[H, W, 3]`` uint8."""
    return (image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)


def encode_image(pixels: NDArray[np.generic], kind: str = "PNG", **options: Any) -> bytes:
    """Encodes an 8-bit colour ``[H, W, 3]`` or 16-bit grey ``[H, W]`` image; ``options`` are Pillow's."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def write_png(path: str | Path, image: Tensor) -> Path:
    """Writes an image ``[3, H, W]`` in [0, 1] as an 8-bit PNG, atomically; returns the path."""
    return write_bytes(path, encode_image(to_pixels(image)))


def curvatures(grey: NDArray[np.float32], step: int = 1) -> NDArray[np.float64]:
    """Returns the mean squared second differences, in four directions, ``[4]``, of an image reduced by ``step``."""
    rows, columns = grey.shape[0] // step, grey.shape[1] // step
    if min(rows, columns) < 3:
        return np.zeros(4)
    small = grey[: rows * step, : columns * step].reshape(rows, step, columns, step).mean((1, 3))
    found = []
    for y, x in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before, after = (small[1 + s * y : rows - 1 + s * y, 1 + s * x : columns - 1 + s * x] for s in (-1, 1))
        found.append(((2 * small[1:-1, 1:-1] - before - after) ** 2).mean(dtype=np.float64))
    return np.array(found)
