"""What was drawn over images is found; scenery and cameras that stand still are not taken for it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from vg2gt.inputs import usable
from vg2gt.inputs.overlays import find_overlays
from vg2gt.inputs.pictures import find_pictures
from vg2gt.inputs.usable import usable_pictures
from vg2gt.monitor import Monitor

SHAPE = (180, 320)


def views(count: int, step: int = 12) -> list[np.ndarray]:
    """A camera that moves along grey noise with structures of all sizes, uint8 ``[h, w, 3]`` each."""
    rng, wall = np.random.default_rng(0), np.zeros((SHAPE[0] + step * count, SHAPE[1] + step * count))
    for size in (1, 2, 4, 8, 16):
        wall += size * ndimage.gaussian_filter(rng.normal(size=wall.shape), size)
    grey = (120 + 80 * np.tanh(wall / wall.std() / 2)).astype(np.uint8)
    places = [(slice(step * k, step * k + SHAPE[0]), slice(step * k, step * k + SHAPE[1])) for k in range(count)]
    return [grey[place][..., None].repeat(3, 2) for place in places]


def written(image: np.ndarray, text: str, at: tuple[int, int], opaque: int = 255) -> np.ndarray:
    """Writes a text over an image."""
    shown = Image.fromarray(image)
    ImageDraw.Draw(shown, "RGBA").text(
        at, text, fill=(255, 255, 255, opaque), font=ImageFont.load_default(20), stroke_width=1,
        stroke_fill=(0, 0, 0, opaque),
    )  # fmt: skip
    return np.asarray(shown)


def where(images: list[np.ndarray], plain: list[np.ndarray]) -> list[np.ndarray]:
    return [np.abs(own.astype(int) - other).max(2) > 0 for own, other in zip(images, plain, strict=True)]


@pytest.mark.parametrize("opaque", [255, 140])
def test_logos_and_dates_are_masked_in_photographs(tmp_path: Path, opaque: int, caplog, monkeypatch) -> None:
    """Also in those that are not among the samples."""
    monkeypatch.setattr(usable, "IN_MEMORY", 9)
    plain = views(18)
    images = [written(written(own, "NEWS 24", (225, 10), opaque), "30.11.2026", (12, 150)) for own in plain]
    for number, own in enumerate(images):
        Image.fromarray(own).save(tmp_path / f"{number}.jpg", quality=90)
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    assert "18 images have a logo, a date or a text over them" in caplog.text
    mask = found[3].read(SHAPE).mask[0].numpy()
    assert mask[where(images, plain)[3]].mean() < 0.02
    assert mask.mean() > 0.85


def test_subtitles_that_last_for_some_frames_are_found() -> None:
    plain = views(24)
    images = [written(own, ("Here we are", "", "in a long hall")[k // 8], (90, 150)) for k, own in enumerate(plain)]
    found = find_overlays(images, is_video=True)
    for own, drawn in zip(where(images, plain), found, strict=True):
        assert not own.any() or drawn[own].mean() > 0.97
    assert not found[12].any()
    assert max(own.mean() for own in found) < 0.15


def test_scenery_and_still_cameras_are_not_taken_for_overlays() -> None:
    noise = np.random.default_rng(1)
    still = [np.clip(views(1)[0] + noise.normal(0, 2, (*SHAPE, 3)), 0, 255).astype(np.uint8) for _ in range(9)]
    shaking = [np.roll(views(1)[0], shift, 1) for shift in (0, 1, 0, -1, 0, 1, 1, 0, -1)]
    few = [written(own, "NEWS 24", (225, 10)) for own in views(7)]
    for images in (views(20), views(20, 2), still, shaking, few):
        assert not any(own.any() for own in find_overlays(images, is_video=True))
