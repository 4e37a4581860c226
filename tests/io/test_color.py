"""Colours of phones: ICC profiles, colour tags, HLG and PQ, all as sRGB."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from vg2gt.io.image_files import read_color
from vg2gt.io.video import read_video

P3 = np.array([[0.4865709, 0.2656677, 0.1982173], [0.2289746, 0.6917385, 0.0792869], [0.0, 0.0451134, 1.0439444]])
SRGB = np.array([[0.4123908, 0.357584, 0.180481], [0.2126390, 0.7151687, 0.0721923], [0.0193308, 0.1191948, 0.950532]])
ADOBE = np.array([[0.5766690, 0.185558, 0.188229], [0.2973450, 0.6273636, 0.0752915], [0.0270314, 0.0706889, 0.991338]])
BT2020 = np.array([[0.6369580, 0.1446169, 0.1688810], [0.2627002, 0.6779981, 0.0593017], [0.0, 0.0280727, 1.0609851]])


def _scene(size: tuple[int, int] = (32, 48)) -> np.ndarray:
    """Smooth colours, some of them strong, in sRGB."""
    y, x = np.mgrid[: size[0], : size[1]]
    u, v = x / (size[1] - 1), y / (size[0] - 1)
    return (np.stack((u, v, (1 - u) * (1 - v)), -1) * 255 + 0.5).astype(np.uint8)


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _coded(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light.clip(1e-9) ** (1 / 2.4) - 0.055)


def _in(primaries: np.ndarray, coded) -> np.ndarray:
    """The scene's pixels in other primaries and another transfer function, uint8."""
    light = _linear(_scene() / 255) @ (np.linalg.inv(primaries) @ SRGB).T
    return (coded(light.clip(0, 1)) * 255 + 0.5).astype(np.uint8)


def _s15(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def _profile(kind: bytes, tags: dict[bytes, bytes]) -> bytes:
    """An ICC profile of version 4 with the given elements."""
    start, table, data = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    head = struct.pack(">I4xI4s4s4s12x4s24x", start + len(data), 0x04300000, b"mntr", kind, b"XYZ ", b"acsp")
    return (head + _s15(0.9642, 1, 0.8249)).ljust(128, b"\0") + table + data


def _curve(*parameters: float) -> bytes:
    kind = 3 if len(parameters) == 5 else 0
    return b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + _s15(*parameters)


TEXT = b"mluc\0\0\0\0" + struct.pack(">II2s2sII", 1, 12, b"en", b"US", 2, 28) + b"\0x"
USUAL = _curve(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
XYZ = b"XYZ \0\0\0\0"
NAMED = {b"desc": TEXT, b"cprt": TEXT, b"wtpt": XYZ + _s15(0.9642, 1, 0.8249)}
DISPLAY_P3 = _profile(
    b"RGB ",
    NAMED
    | {b"rXYZ": XYZ + _s15(0.51512, 0.2412, -0.00105), b"gXYZ": XYZ + _s15(0.29198, 0.69225, 0.04189)}
    | {b"bXYZ": XYZ + _s15(0.1571, 0.06657, 0.78407), b"rTRC": USUAL, b"gTRC": USUAL, b"bTRC": USUAL},
)


def _error(path: Path) -> np.ndarray:
    return np.abs(read_color(path, "").astype(int) - _scene())


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif", "alpha.png"])
def test_profiles_are_applied(tmp_path: Path, name: str) -> None:
    pixels = _in(P3, _coded)
    image = Image.fromarray(pixels)
    if name.startswith("alpha"):
        image.putalpha(255)
    quality = {"quality": 100, "subsampling": 0} if name.endswith("jpg") else {}
    image.save(tmp_path / name, icc_profile=DISPLAY_P3, **quality, **({"lossless": True} if "webp" in name else {}))
    assert np.abs(pixels.astype(int) - _scene()).max() > 30
    assert _error(tmp_path / name).mean() < 2
    assert np.percentile(_error(tmp_path / name), 98) < 8  # of 8 bits in the dark, and of JPEG


def test_profiles_of_grey_and_of_srgb(tmp_path: Path) -> None:
    ramp = np.arange(256, dtype=np.uint8)[None].repeat(8, 0)
    grey = _profile(b"GRAY", NAMED | {b"kTRC": _curve(1.8)})
    Image.fromarray(ramp).save(tmp_path / "a.png", icc_profile=grey)
    expected = _coded((ramp[0] / 255) ** 1.8) * 255
    assert np.abs(read_color(tmp_path / "a.png", "")[0, :, 1] - expected).max() < 2
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for image in (Image.fromarray(_scene()), Image.fromarray(ramp)):  # grey photographs keep a profile of colours
        image.save(tmp_path / "a.png", icc_profile=srgb)
        assert np.array_equal(read_color(tmp_path / "a.png", ""), np.asarray(image.convert("RGB")))


def test_a_damaged_or_foreign_profile_is_named(tmp_path: Path, caplog) -> None:
    cmyk = _profile(b"CMYK", NAMED)
    for profile in (DISPLAY_P3[:200], b"nothing", cmyk):
        caplog.clear()
        Image.fromarray(_scene()).save(tmp_path / "a.png", icc_profile=profile)
        assert _error(tmp_path / "a.png").max() == 0
        assert "a.png cannot be used" in caplog.text


def test_tags_without_a_profile(tmp_path: Path) -> None:
    adobe = Image.fromarray(_in(ADOBE, lambda light: light ** (256 / 563)))
    exif = Image.Exif()
    exif[0x8769] = {0xA001: 0xFFFF, 0xA005: {1: "R03"}}
    adobe.save(tmp_path / "_DSC1.jpg", quality=100, subsampling=0, exif=exif)
    assert _error(tmp_path / "_DSC1.jpg").mean() < 2
    if "AVIF" in Image.OPEN:  # the code point of Display P3 in place of that of sRGB
        Image.fromarray(_in(P3, _coded)).save(tmp_path / "a.avif", quality=98, subsampling="4:4:4")
        content = (tmp_path / "a.avif").read_bytes()
        place = content.index(b"colrnclx") + 8
        (tmp_path / "a.avif").write_bytes(content[:place] + b"\0\x0c" + content[place + 2 :])
        assert _error(tmp_path / "a.avif").mean() < 2
    content = io.BytesIO()
    adobe.save(content, "PNG")

    def chunk(kind: bytes, *values: float) -> bytes:
        data = kind + struct.pack(f">{len(values)}I", *(round(100000 * value) for value in values))
        return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))

    tags = chunk(b"gAMA", 1 / 2.2) + chunk(b"cHRM", 0.3127, 0.329, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
    (tmp_path / "a.png").write_bytes(content.getvalue()[:33] + tags + content.getvalue()[33:])
    assert _error(tmp_path / "a.png").mean() < 2
    content = io.BytesIO()  # code points of Display P3, which take precedence over a profile
    Image.fromarray(_in(P3, _coded)).save(content, "PNG", icc_profile=_profile(b"RGB ", NAMED))
    data = b"cICP" + bytes([12, 13, 0, 1])
    tags = struct.pack(">I", 4) + data + struct.pack(">I", zlib.crc32(data))
    (tmp_path / "a.png").write_bytes(content.getvalue()[:33] + tags + content.getvalue()[33:])
    assert _error(tmp_path / "a.png").mean() < 2


def _hlg(light: np.ndarray) -> np.ndarray:
    """HLG signal of light in units of diffuse white on a display of 1000 cd/m2, in the primaries of BT.2020."""
    shown = light * 203 / 1000
    luminance = (shown @ np.array([0.2627, 0.678, 0.0593])).clip(1e-9)[..., None]
    scene = shown * luminance ** (1 / 1.2 - 1)
    high = 0.17883277 * np.log((12 * scene - 0.28466892).clip(1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene.clip(0)), high)


def _pq(light: np.ndarray) -> np.ndarray:
    power = (light.clip(0) * 203 / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


@pytest.mark.parametrize(("transfer", "coded"), [(18, _hlg), (16, _pq), (14, _coded)])
def test_videos_of_phones_show_the_colours_of_the_scene(tmp_path: Path, transfer: int, coded) -> None:
    av = pytest.importorskip("av")
    size = (128, 192)
    light = _linear(_scene(size) / 255) @ (np.linalg.inv(BT2020) @ SRGB).T
    deep = (coded(light.clip(0)) * 65535 + 0.5).astype(np.uint16)
    with av.open(str(tmp_path / "phone.mov"), "w") as container:
        stream = container.add_stream("libx264", 10, {"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = size[1], size[0], "yuv420p10le"
        context = stream.codec_context
        context.color_primaries = context.colorspace = 9
        context.color_trc, context.color_range = transfer, 1
        frame = av.VideoFrame.from_ndarray(deep, "rgb48le")
        coded_frame = frame.reformat(format="yuv420p10le", dst_colorspace=9, dst_color_range=1, interpolation=0x42004)
        container.mux(stream.encode(coded_frame))
        container.mux(stream.encode(None))
    ((_, shown),) = read_video(tmp_path / "phone.mov")
    assert np.abs(shown.astype(int) - _scene(size)).mean() < 2
    assert np.abs(deep / 257 - _scene(size)).mean() > 8  # what the file holds


@pytest.mark.parametrize("height", [96, 720])
def test_videos_without_tags_are_shown_as_players_do(tmp_path: Path, height: int) -> None:
    av = pytest.importorskip("av")
    pixels = _scene((height, 96))
    with av.open(str(tmp_path / "old.mkv"), "w") as container:
        stream = container.add_stream("libx264", 10, {"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = 96, height, "yuv420p"
        matrix = 1 if height == 720 else 5  # BT.709 in high definition
        frame = av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(
            format="yuv420p", dst_colorspace=matrix, dst_color_range=1, interpolation=0x42004
        )
        frame.colorspace = 2
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    ((_, shown),) = read_video(tmp_path / "old.mkv")
    assert np.abs(shown.astype(int) - pixels).mean() < 2
