"""Conversion of images of any colour space to 8-bit sRGB: ICC profiles, colour tags, HLG and PQ.

LittleCMS (Pillow's ``ImageCms``) applies ICC profiles. Code points of primaries and transfer functions are those of
ITU-T H.273. HLG and PQ (ITU-R BT.2100) are shown such that diffuse white, 203 cd/m2 (ITU-R BT.2408), becomes white;
brighter highlights are clipped. SDR transfer functions are taken as sRGB's, as browsers and players do.
"""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

log = logging.getLogger(__name__)

PQ, HLG = 16, 18
_WHITE = 203.0  # cd/m2 of diffuse white
_HLG_PEAK, _HLG_GAMMA = 1000.0, 1.2  # cd/m2 of the reference display, and its system gamma
_D65 = (0.3127, 0.3290)
# Chromaticities x, y of white, red, green and blue.
_SRGB = (_D65, (0.640, 0.330), (0.300, 0.600), (0.150, 0.060))
_P3 = (_D65, (0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
_ADOBE = (_D65, (0.640, 0.330), (0.210, 0.710), (0.150, 0.060))
_PRIMARIES = {9: (_D65, (0.708, 0.292), (0.170, 0.797), (0.131, 0.046)), 11: _P3, 12: _P3}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
_STRIP = 1 << 18  # pixels converted at a time
_NOTHING = 1  # difference of 8-bit values up to which a profile is taken as sRGB

Chromaticities = Sequence[Sequence[float]]


def needs_conversion(primaries: int, transfer: int) -> bool:
    """Returns whether pixels with these H.273 code points differ from sRGB."""
    return primaries in _PRIMARIES or transfer in (PQ, HLG)


def coded_to_srgb(pixels: NDArray[Any], primaries: int, transfer: int) -> NDArray[np.uint8]:
    """Converts full-range RGB ``[H, W, 3]``, uint8 or uint16, with H.273 code points to sRGB."""
    values = np.linspace(0, 1, np.iinfo(pixels.dtype).max + 1)
    linear = {PQ: _from_pq, HLG: _from_hlg}.get(transfer, _from_srgb)(values)
    return _converted(pixels, linear, _to_srgb_primaries(_PRIMARIES.get(primaries, _SRGB)), transfer == HLG)


def to_srgb(image: Image.Image) -> Image.Image:
    """Converts an image to sRGB by its ICC profile, or else by its other colour tags; RGB unless nothing is known.

    A profile that cannot be read or does not fit the image is ignored with a warning.
    """
    profile = image.info.get("icc_profile")
    known = _code_points(image)
    if profile and not (image.format == "PNG" and known):  # PNG's code points take precedence
        try:
            return _by_profile(image, profile)
        except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
            name = getattr(image, "filename", "") or "an image"
            log.warning("the colour profile of %s cannot be used (%s): its colours are taken as sRGB", name, error)
        return image
    if image.mode not in ("RGB", "RGBA", "P", "PA", "L", "LA"):
        return image
    primaries, transfer = known or (1, 1)
    if needs_conversion(primaries, transfer):
        return Image.fromarray(coded_to_srgb(np.asarray(image.convert("RGB")), primaries, transfer))
    gamma, chromaticities = 1 / 2.2, _SRGB
    if image.format == "PNG" and "srgb" not in image.info:
        gamma = float(image.info.get("gamma") or gamma)
        if flat := image.info.get("chromaticity"):
            chromaticities = tuple(zip(flat[::2], flat[1::2], strict=True))
    elif _is_adobe(image):
        chromaticities = _ADOBE
    matrix = _to_srgb_primaries(chromaticities)
    if abs(gamma * 2.2 - 1) < 0.05 and np.abs(matrix - np.eye(3)).max() < 0.01:
        return image
    linear = np.linspace(0, 1, 256) ** (1 / gamma)
    return Image.fromarray(_converted(np.asarray(image.convert("RGB")), linear, matrix))


def _by_profile(image: Image.Image, profile: bytes) -> Image.Image:
    space = _profile_space(profile)
    modes = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
    if space not in modes:
        raise ValueError(f"it is for {space} images")
    if (image.mode == "CMYK") != (space == "CMYK"):
        raise ValueError(f"it is for {space} images, not {image.mode}")
    fitting = image.convert(modes[space])
    transform = _transform(profile, fitting.mode)
    return image if transform is None else ImageCms.applyTransform(fitting, transform) or fitting


@lru_cache(maxsize=16)
def _profile_space(profile: bytes) -> str:
    opened: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile)).profile
    return opened.xcolor_space.strip()


@lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Returns the transformation of a profile to sRGB; None if it changes nothing."""
    transform = ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(profile)),
        ImageCms.createProfile("sRGB"),
        mode,
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    if mode == "CMYK":
        return transform
    steps = np.linspace(0, 255, 18).astype(np.uint8)
    probe = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 18, 3) if mode == "RGB" else steps[None]
    shown = ImageCms.applyTransform(Image.fromarray(probe), transform)
    same = probe if mode == "RGB" else probe[..., None]
    return None if shown and np.abs(np.asarray(shown).astype(int) - same).max() <= _NOTHING else transform


def _code_points(image: Image.Image) -> tuple[int, int] | None:
    """Returns the primaries and transfer function of an AVIF or HEIF file (its colour box) or a PNG (cICP), if any."""
    name = getattr(image, "filename", "")
    layouts = {"AVIF": (b"colrnclx", ">HH"), "HEIF": (b"colrnclx", ">HH"), "PNG": (b"\0\0\0\4cICP", ">BB")}
    if image.format not in layouts or not name:
        return None
    mark, values = layouts[image.format]
    with open(name, "rb") as file:
        _, found, rest = file.read(1 << 16).partition(mark)
    size = struct.calcsize(values)
    return struct.unpack(values, rest[:size]) if found and len(rest) >= size else None


def _is_adobe(image: Image.Image) -> bool:
    """Returns whether a photograph is in Adobe RGB by the rules of DCF, as cameras without ICC profiles say it."""
    try:
        exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
        if exif.get(ExifTags.Base.ColorSpace) == 2:
            return True
        interop = image.getexif().get_ifd(ExifTags.IFD.Interop)
        return exif.get(ExifTags.Base.ColorSpace) == 0xFFFF and str(interop.get(1, "")).startswith("R03")
    except Exception:  # damaged EXIF data raise various errors
        return False


def _from_srgb(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _from_hlg(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns scene light in [0, 1] (inverse OETF of HLG)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(values <= 0.5, values**2 / 3, (np.exp((values - c) / a) + b) / 12)


def _from_pq(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns display light in units of diffuse white (EOTF of PQ)."""
    c1, c2, c3 = 107 / 128, 2413 / 128, 2392 / 128
    root = values ** (32 / 2523)
    return 10000 / _WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (8192 / 1305)


def _to_srgb_primaries(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """Returns the matrix ``[3, 3]`` from linear RGB of other primaries and white to that of sRGB."""
    there, white = _rgb_to_xyz(chromaticities)
    srgb, d65 = _rgb_to_xyz(_SRGB)
    adaptation = np.linalg.inv(_BRADFORD) @ np.diag((_BRADFORD @ d65) / (_BRADFORD @ white)) @ _BRADFORD
    return np.linalg.inv(srgb) @ adaptation @ there


def _rgb_to_xyz(chromaticities: Chromaticities) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    white, *colors = (np.array([x / y, 1.0, (1 - x - y) / y]) for x, y in chromaticities)
    columns = np.stack(colors, 1)
    return columns * np.linalg.solve(columns, white), white


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Returns the 8-bit sRGB value of linear light in 1/65535."""
    light = np.linspace(0, 1, 1 << 16)
    coded = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return (coded * 255 + 0.5).astype(np.uint8)


@lru_cache(maxsize=1)
def _system_gains() -> NDArray[np.float32]:
    """Returns display light in units of diffuse white per scene light, by the scene's luminance in 1/65535 (HLG)."""
    luminance = np.maximum(np.arange(1 << 16), 0.5) / 65535
    return (_HLG_PEAK / _WHITE * luminance ** (_HLG_GAMMA - 1)).astype(np.float32)


def _converted(
    pixels: NDArray[Any], linear: NDArray[np.float64], matrix: NDArray[np.float64], hlg: bool = False
) -> NDArray[np.uint8]:
    """Converts pixels ``[H, W, 3]`` by the linear light of each stored value and a matrix ``[3, 3]``, in strips."""
    table, turned, encoded = linear.astype(np.float32), matrix.T.astype(np.float32), _srgb_table()
    result = np.empty(pixels.shape, np.uint8)
    rows = max(1, _STRIP // max(pixels.shape[1], 1))
    for start in range(0, len(pixels), rows):
        light = table[pixels[start : start + rows]]
        if hlg:  # the display's system gamma acts on luminance
            light *= _system_gains()[(light @ _LUMA_2020 * 65535 + 0.5).astype(np.uint16)][..., None]
        light = light @ turned
        result[start : start + rows] = encoded[(light.clip(0, 1) * 65535 + 0.5).astype(np.uint16)]
    return result
