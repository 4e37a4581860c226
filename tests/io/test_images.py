"""Pictures of depth, normals and grids."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.io.errors import DataError
from vg2gt.io.image_files import image_size, read_color, read_mask, read_mask_file
from vg2gt.io.images import colorize_depth, grid, write_png


def test_depth_colours_are_monotone_in_brightness_and_holes_are_grey() -> None:
    depth = torch.linspace(1, 3, 50)[None].clone()
    depth[0, 10], depth[0, 20] = 0, torch.nan
    picture = colorize_depth(depth, 1.0, 3.0)
    assert (picture[:, 0, [10, 20]] == 0.5).all()
    brightness = picture.mean(0)[0]
    keep = depth[0] > 0
    assert bool((brightness[keep].diff() < 0).all())


def test_grid_places_panels(tmp_path: Path) -> None:
    panels = [[torch.full((3, 4, 6), value) for value in row] for row in ((0.0, 0.2), (0.4, 0.6))]
    picture = grid(panels, gap=2)
    assert (picture.shape, picture[0, 0, 8]) == ((3, 10, 14), 0.2)
    assert (picture[0, 6, 0], picture[0, 4, 0]) == (0.4, 1)
    written = np.asarray(Image.open(write_png(tmp_path / "grid.png", picture)))
    assert (written.shape, written[0, 8, 0]) == ((10, 14, 3), 51)


# Rows of an upright image as they are stored, by EXIF orientation (standard table).
STORED = {
    2: np.fliplr,
    3: lambda upright: np.rot90(upright, 2),
    4: np.flipud,
    5: lambda upright: np.swapaxes(upright, 0, 1),
    6: lambda upright: np.rot90(upright, 1),
    7: lambda upright: np.swapaxes(np.rot90(upright, 2), 0, 1),
    8: lambda upright: np.rot90(upright, -1),
}


@pytest.mark.parametrize("orientation", STORED)
def test_photographs_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    upright = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.ascontiguousarray(STORED[orientation](upright))
    for name in ("a.png", "a.tif"):
        Image.fromarray(stored).save(tmp_path / name, exif=exif)
        assert image_size(tmp_path / name, "room", upright=True) == (20, 30), name
        assert np.array_equal(read_color(tmp_path / name, "room", (20, 30), upright=True), upright), name
        assert np.array_equal(read_color(tmp_path / name, "room", stored.shape[:2]), stored), name


def test_grey_photographs_are_no_masks_and_masks_may_hold_zero_and_one(tmp_path: Path) -> None:
    half = (np.arange(30) < 15) * np.ones((20, 1), np.uint8)
    for name, pixels in {"8 bits": half * 255, "16 bits": half.astype(np.uint16) * 65535, "one": half}.items():
        Image.fromarray(pixels).save(tmp_path / "a.png")
        assert read_mask(tmp_path / "a.png", "") is None, name
        assert np.array_equal(read_mask(tmp_path / "a.png", "", is_mask=True), half), name


def test_masks_with_an_opaque_alpha_or_dark_labels(tmp_path: Path) -> None:
    half = (np.arange(30) < 15) * np.ones((20, 1), np.uint8)
    opaque = Image.fromarray(half * 255).convert("RGBA")
    labels = Image.fromarray(half * np.arange(1, 31, dtype=np.uint8)).convert("P")
    labels.putpalette([0, 0, 0] + 15 * [128, 0, 0, 0, 64, 0])
    for image in (opaque, labels):
        image.save(tmp_path / "a.png")
        assert np.array_equal(read_mask(tmp_path / "a.png", "", is_mask=True), half), image.mode


def test_a_mask_of_stored_pixels_is_turned_with_its_photograph(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    upright = np.zeros((30, 20), np.uint8)
    upright[:10] = 255
    stored = np.ascontiguousarray(STORED[6](upright))
    Image.fromarray(stored).save(tmp_path / "photo.png", exif=exif)
    for mask in (stored, upright):
        Image.fromarray(mask).save(tmp_path / "mask.png")
        assert np.array_equal(read_mask_file(tmp_path / "mask.png", "", tmp_path / "photo.png", True), upright / 255)


@pytest.mark.parametrize("size", [(20, 30), (10, 15), (40, 60), (7, 10), (20, 20), (30, 20), (20, 40)])
def test_a_mask_of_another_shape_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    """A resized mask fits; one of a cropped or padded image would hide other pixels than was meant."""
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(tmp_path / "photo.png")
    Image.fromarray(np.zeros(size, np.uint8)).save(tmp_path / "mask.png")
    if size[0] * 3 in (size[1] * 2, size[1] * 2 + 1):
        assert read_mask_file(tmp_path / "mask.png", "", tmp_path / "photo.png").shape == size
        return
    with pytest.raises(DataError, match=rf"mask.png is {size[1]}x{size[0]} pixels, but its image .*photo.png is 30x20"):
        read_mask_file(tmp_path / "mask.png", "", tmp_path / "photo.png")


RAMP = np.linspace(0, 65535, 24 * 32).reshape(24, 32)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_16_bit_grey_photographs_keep_their_greys(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"photo.{suffix}"
    Image.fromarray(RAMP.astype(np.uint16)).save(path)
    assert np.abs(read_color(path, "scene") - RAMP[..., None] / 257).max() <= 0.51


@pytest.mark.parametrize(("dtype", "kind"), [(np.int32, "32-bit integers"), (np.float32, "floating-point numbers")])
def test_photographs_without_a_known_white_are_refused(tmp_path: Path, dtype: type, kind: str) -> None:
    Image.fromarray(RAMP.astype(dtype)).save(tmp_path / "photo.tif")
    with pytest.raises(DataError, match=rf"photo\.tif of scene room: .* a photograph of {kind} is unknown"):
        read_color(tmp_path / "photo.tif", "room")


@pytest.mark.parametrize("kind", ["jpg", "png", "rgba.png", "grey.jpg"])
@pytest.mark.parametrize("size", [(160, 240), (157, 243)])
def test_large_images_are_reduced_while_they_are_read(tmp_path: Path, kind: str, size, monkeypatch) -> None:
    """The whole of the image, turned upright, and never less than twice what suffices."""
    monkeypatch.setattr("vg2gt.io.image_files._LARGE", 10_000)
    height, width = size
    y, x = np.mgrid[:height, :width]
    smooth = np.stack((x * 250 / width, y * 250 / height, np.full(size, 80)), -1).astype(np.uint8)
    image = Image.fromarray(smooth)
    image = {"rgba.png": image.convert("RGBA"), "grey.jpg": image.convert("L")}.get(kind, image)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise
    image.transpose(Image.Transpose.ROTATE_90).save(tmp_path / f"a.{kind}", quality=98, subsampling=0, exif=exif)
    whole = read_color(tmp_path / f"a.{kind}", "", upright=True)
    assert whole.shape == (*size, 3)
    for least, factor in (((30, 40), 2), ((18, 25), 4), ((9, 14), 8), ((90, 130), 1)):
        found = read_color(tmp_path / f"a.{kind}", "", upright=True, least=least)
        shape = (round(height / factor), round(width / factor))
        assert found.shape == (*shape, 3)
        assert found.shape[0] >= 2 * least[0] or factor == 1
        wanted = Image.fromarray(whole).resize(shape[::-1], Image.Resampling.BOX)
        inner = np.abs(found.astype(int) - np.asarray(wanted))[1:-1, 1:-1]
        assert inner.mean() < 1
        assert inner.max() < 6
    monkeypatch.setattr("vg2gt.io.image_files._LARGE", 10**6)
    assert read_color(tmp_path / f"a.{kind}", "", upright=True, least=(18, 25)).shape == whole.shape


def test_images_of_up_to_300_megapixels_are_opened(tmp_path: Path, monkeypatch) -> None:
    """Pillow alone refuses 179 million and warns from 89 million."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 50)
    Image.new("RGB", (40, 20)).save(tmp_path / "a.jpg")
    assert image_size(tmp_path / "a.jpg", "") == (20, 40)
    assert Image.MAX_IMAGE_PIXELS == 50
    monkeypatch.setattr("vg2gt.io.images.MOST_PIXELS", 799)
    with pytest.raises(DataError, match="has 40x20 pixels, more than"):
        image_size(tmp_path / "a.jpg", "")
