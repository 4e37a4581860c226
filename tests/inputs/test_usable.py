"""Images that show nothing are left out by name, borders are masked."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageEnhance, ImageFilter

from tests.inputs.test_foreign import nvm
from tests.inputs.test_given_cameras import NAMES, put_cameras, put_colmap, put_poses
from vg2gt.data.base import DataError
from vg2gt.inputs.cameras import pictures_for
from vg2gt.inputs.pictures import find_pictures
from vg2gt.inputs.usable import usable_pictures
from vg2gt.io import write_video
from vg2gt.monitor import Monitor

SHAPE = (96, 144)


def scenery(seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Grey noise with structures of all sizes, uint8 ``[h, w, 3]``, no pixel darker than 40."""
    rng, found = np.random.default_rng(seed), np.zeros((*shape, 1))
    for step in (1, 2, 4, 8, 16, 32):
        noise = rng.normal(size=(-(-shape[0] // step), -(-shape[1] // step), 1)).astype(np.float32)
        found += step**0.5 * noise.repeat(step, 0).repeat(step, 1)[: shape[0], : shape[1]]
    return (130 + 90 * np.tanh(found / found.std() / 2)).astype(np.uint8).repeat(3, 2)


def spoil(path: Path, how: str) -> None:
    """Damages an image in one of the ways that people have."""
    with Image.open(path) as image:
        size, whole = image.size, image.convert("RGB")
    if how == "zeros":  # an interrupted copy; what comes after the end of an image does not matter
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2].ljust(len(content), b"\0"))
        return
    if how in ("empty", "cut"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 if how == "cut" else 0])
        return
    rng = np.random.default_rng(0)
    noise = np.abs(rng.normal(0, 9, (size[1], size[0], 3)))  # of the sensor
    dark, bright = noise.astype(np.uint8), (255 - noise / 4).astype(np.uint8)
    bright[:5, :20] = 100  # a rest that is not clipped
    moved = np.mean([np.roll(np.asarray(whole, np.float32), k, 1) for k in range(size[0] // 10)], 0)
    disc = np.hypot(*(np.indices(size[::-1]) - np.array(size[::-1])[:, None, None] / 2)) < size[1] / 4
    spoilt = {
        "silhouette": 255 * disc.astype(np.uint8),
        "black": dark,
        "white": bright,
        "blur": np.asarray(whole.filter(ImageFilter.GaussianBlur(size[0] / 40))),
        "shake": moved.astype(np.uint8),
        "grey": (128 + noise / 2).astype(np.uint8),
    }
    Image.fromarray(spoilt[how]).save(path)


SAID = {
    "empty": "cannot be read (the file is empty)",
    "cut": "cannot be read (image file is truncated",
    "zeros": "cannot be read (the end of the file is zeros",
    "black": "is black",
    "white": "is over-exposed",
    "blur": "is blurred",
    "shake": "is blurred",
    "grey": "is of one colour",
    "silhouette": "is black and white only (a mask?",
}


def test_what_shows_nothing_is_left_out_by_name(tmp_path: Path, caplog) -> None:
    kinds = [*SAID, *(f"good{number}" for number in range(9))]
    for number, kind in enumerate(kinds):
        Image.fromarray(scenery(number, (288, 432))).save(tmp_path / f"{kind}.jpg", quality=92)
        if kind in SAID:
            spoil(tmp_path / f"{kind}.jpg", kind)
    with (tmp_path / "good0.jpg").open("ab") as file:
        file.write(bytes(5000))
    (tmp_path / "text.jpg").write_text("no image")
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    assert [picture.name for picture in found] == [kind for kind in kinds if kind.startswith("good")]
    for kind, said in SAID.items():
        assert f"{kind} {said}" in caplog.text.replace(f"{tmp_path}/", "").replace(".jpg", "")
    assert "text.jpg cannot be read" in caplog.text


def test_grey_among_coloured_and_one_photograph_in_two_formats_are_left_out(tmp_path: Path, caplog) -> None:
    """Bands of thermal and multispectral cameras next to the photographs; IMG_1.HEIC and IMG_1.JPG."""
    tint = np.array([1.0, 0.7, 0.4])
    for number in range(5):
        pixels = (scenery(number) * (1 if number == 3 else tint)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{number}.jpg", quality=92)
    Image.open(tmp_path / "0.jpg").save(tmp_path / "0.png")
    Image.fromarray((scenery(9) * tint).astype(np.uint8)).save(tmp_path / "1.png")  # another one
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    assert [picture.path.name for picture in found if picture.path] == ["0.jpg", "1.jpg", "1.png", "2.jpg", "4.jpg"]
    assert "3 is without colour" in caplog.text
    assert f"shows the same as {tmp_path / '0.jpg'}" in caplog.text


def photograph(seed: int) -> Image.Image:
    """Large structures with fine detail, 432 x 288 pixels."""
    coarse = Image.fromarray(scenery(seed, (36, 54))).resize((432, 288), Image.Resampling.BICUBIC)
    return Image.blend(coarse, Image.fromarray(scenery(seed, (288, 432))), 0.3)


def test_versions_of_a_photograph_are_left_out(tmp_path: Path, caplog) -> None:
    """Edited, reduced and recompressed ones were used as further views.

    Sequences of related names and frames of two cameras side by side are kept, and the version of one that is spoilt.
    """
    for folder in ("web", "left", "right", "edited"):
        (tmp_path / folder).mkdir()
    for number in range(4):
        photograph(number).save(tmp_path / f"IMG_{number}.jpg", quality=92)
        photograph(number).resize((216, 144)).save(tmp_path / "web" / f"IMG_{number}.jpg")
        edited = ImageEnhance.Color(photograph(number).filter(ImageFilter.UnsharpMask())).enhance(0.4)
        Image.eval(edited, lambda value: int(255 * (value / 255) ** 0.6)).save(
            tmp_path / "edited" / f"IMG_{number}.jpg"
        )
        photograph(number + 20).save(tmp_path / "left" / f"{number}.jpg", quality=92)
        shifted = np.roll(np.array(photograph(number + 20)), 1, 1)
        Image.fromarray(shifted).save(tmp_path / "right" / f"{number}.jpg", quality=92)
        photograph(50).save(tmp_path / f"slow {number}.jpg", quality=90 + number)
    photograph(50).save(tmp_path / "slow.jpg", quality=95)
    Image.eval(photograph(0), lambda value: min(255, value * 1.2)).save(tmp_path / "IMG_0-edited.jpg")
    photograph(0).save(tmp_path / "IMG_0 (1).jpg", quality=50)
    photograph(1).filter(ImageFilter.UnsharpMask()).save(tmp_path / "IMG_E1.jpg", quality=92)
    photograph(7).filter(ImageFilter.GaussianBlur(9)).save(tmp_path / "IMG_7.jpg", quality=92)
    photograph(7).save(tmp_path / "IMG_7-1.jpg", quality=92)
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    names = {str(each.path.relative_to(tmp_path)) for each in found if each.path is not None}
    places = ("IMG_", "left/", "right/", "slow ")
    assert names == {"IMG_7-1.jpg", "slow.jpg", *(f"{place}{number}.jpg" for place in places for number in range(4))}
    assert f"shows the same as {tmp_path / 'IMG_0.jpg'}" in caplog.text
    assert "IMG_7 is blurred" in caplog.text


def test_repeated_frames_of_a_video_are_left_out(tmp_path: Path, caplog) -> None:
    """As of videos that were converted to more frames per second; 24 of them took three times as long as 8."""
    pytest.importorskip("av")
    wide = scenery(1, (96, 200))
    frames = [wide[:, 8 * number : 8 * number + 144] for number in range(4)]
    path = write_video(tmp_path / "walk.mp4", [frame for frame in frames for _ in range(3)])
    found = usable_pictures(find_pictures(path), Monitor())
    assert [int(picture.name[-6:]) // 3 for picture in found] == [0, 1, 2, 3]
    assert "8 of 12 images are left out: " in caplog.text
    assert "walk-000001 repeats the frame before" in caplog.text


def test_stereo_pairs_are_said(tmp_path: Path, caplog) -> None:
    """A frame of a stereo camera was taken for one wide photograph. Wide photographs, also of one colour, are not."""
    for number in range(3):
        wide = scenery(number, (90, 240))
        pair = np.concatenate((wide[:, 8:136], wide[:, :128])[:: 1 - 2 * (number % 2)], 1)
        for name, pixels in (("pair", pair), ("wide", wide), ("flat", np.full_like(wide, 90 + number))):
            (tmp_path / name).mkdir(exist_ok=True)
            Image.fromarray(pixels).save(tmp_path / name / f"{number}.png")
    usable_pictures(find_pictures(tmp_path / "wide"), Monitor())
    with pytest.raises(DataError, match="of one colour"):
        usable_pictures(find_pictures(tmp_path / "flat"), Monitor())
    assert not caplog.text
    assert len(usable_pictures(find_pictures(tmp_path / "pair"), Monitor())) == 3
    assert "3 images show the same twice, side by side" in caplog.text


def test_dark_and_bright_scenes_and_bare_walls_are_kept(tmp_path: Path, caplog) -> None:
    """Night, a white table, an object on black, a wall among textured views."""
    wall = 180 + np.linspace(0, 20, SHAPE[1])[None, :, None] + np.random.default_rng(0).normal(size=(*SHAPE, 3))
    for number in range(5):
        night, table = (scenery(number) // 6), np.full((*SHAPE, 3), 255, np.uint8)
        table[30:50, 40 + number : 70 + number] = scenery(number)[:20, :30]
        for name, pixels in (("night", night), ("table", table), ("object", 255 - table), ("room", scenery(number))):
            (tmp_path / name).mkdir(exist_ok=True)
            Image.fromarray(pixels).save(tmp_path / name / f"{number}.png")
    Image.fromarray(wall.astype(np.uint8)).save(tmp_path / "room" / "wall.png")
    for folder in tmp_path.iterdir():
        pictures = find_pictures(folder)
        kept = usable_pictures(pictures, Monitor())
        assert len(kept) == len(pictures), folder
        assert all(picture.read(SHAPE).mask is None for picture in kept), folder
    assert not caplog.text


def test_pictures_without_a_visible_pixel_or_with_a_broken_mask(tmp_path: Path, caplog) -> None:
    (tmp_path / "masks").mkdir()
    masks = {
        "hidden": np.zeros(SHAPE, np.uint8),
        "half": np.zeros(SHAPE, np.uint8),
        "all": np.full(SHAPE, 255, np.uint8),
    }
    masks["half"][:, ::2] = 255
    for number, name in enumerate(("hidden", "half", "all", "broken", "other")):
        Image.fromarray(scenery(number)).save(tmp_path / f"{name}.png")
        Image.fromarray(masks.get(name, masks["all"])).save(tmp_path / "masks" / f"{name}.png")
    (tmp_path / "masks" / "broken.png").write_bytes(b"")
    Image.fromarray(masks["half"][:, :90]).save(tmp_path / "masks" / "other.png")
    assert [picture.name for picture in usable_pictures(find_pictures(tmp_path), Monitor())] == ["all", "half"]
    assert "hidden is hidden by its mask" in caplog.text
    assert f"broken cannot be read (cannot read {tmp_path / 'masks' / 'broken.png'}: the file is empty" in caplog.text
    assert f"other cannot be read (the mask {tmp_path / 'masks' / 'other.png'} is 90x96 pixels" in caplog.text


def test_nothing_left_is_an_error(tmp_path: Path) -> None:
    for value, name in enumerate(("a.png", "b.png")):
        Image.fromarray(np.full((*SHAPE, 3), value, np.uint8)).save(tmp_path / name)
    with pytest.raises(DataError, match="none of the 2 images can be used: a is black; b is black"):
        usable_pictures(find_pictures(tmp_path), Monitor())
    with pytest.raises(DataError, match="the only image b is black"):
        usable_pictures(find_pictures(tmp_path / "b.png"), Monitor())
    for number, name in enumerate(("a.png", "b.png")):
        Image.fromarray(scenery(number)).save(tmp_path / name)
        spoil(tmp_path / name, "cut")
    with pytest.raises(DataError, match=r"none of the 2 images can be used: a cannot be read \(.*; b cannot be read"):
        usable_pictures(find_pictures(tmp_path), Monitor())
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match=r"none of the 2 images can be used: \S*a\.png cannot be read \(the file is em"):
        find_pictures(tmp_path)


@pytest.mark.parametrize(
    ("layout", "how"),
    [
        *((layout, "empty") for layout in ("cameras.json", "COLMAP", "poses", "nvm")),
        ("COLMAP", "cut"),
        ("poses", "black"),
    ],
)
def test_failed_frames_with_given_cameras(layout, how: str, folder: Path, recording, frames, model, caplog) -> None:
    """A frame of a lens cap cost the others 1.5 dB, a damaged one ended everything."""
    poses, focal = frames.world_to_camera.double().numpy(), float(frames.intrinsics[0, 0, 0])
    {
        "cameras.json": lambda: put_cameras(folder, frames),
        "COLMAP": lambda: put_colmap(folder, frames),
        "poses": lambda: put_poses(folder, recording),
        "nvm": lambda: nvm(folder, poses, focal, np.zeros(2)),
    }[layout]()
    spoil(folder / "images" / NAMES[0], how)
    with pictures_for(model, folder) as pictures:
        assert [picture.name for picture in pictures] == [name[:-4] for name in NAMES[1:]]
        assert torch.allclose(pictures[0].read((84, 112)).world_to_camera[0], frames.world_to_camera[1], atol=1e-5)
    said = [record.message for record in caplog.records if "left out" in record.message]
    assert len(said) == 1
    assert NAMES[0][:-4] in said[0]


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_black_borders_are_masked(tmp_path: Path, suffix: str, caplog) -> None:
    """Of undistorted photographs: black outside of a barrel."""
    shape = (640, 960)
    y, x = np.mgrid[: shape[0], : shape[1]]
    right, down = x / (shape[1] - 1) * 2 - 1, y / (shape[0] - 1) * 2 - 1
    outside = (np.hypot(right, 0.7 * down) > 1.1) | (down < 0.04 * right**2 - 0.97)
    for number in range(3):
        pixels = np.where(outside[..., None], 0, scenery(number, shape)).astype(np.uint8)
        pixels[200:400, 400 + 20 * number : 550] = 0  # something black that is no border
        Image.fromarray(pixels).save(tmp_path / f"{number}.{suffix}", quality=95)
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    assert "3 images have borders of one colour" in caplog.text
    for size in (shape, (96, 144)):
        mask = found[1].read(size).mask[0]
        expected = torch.from_numpy(~outside).float()[None, None]
        inside = torch.nn.functional.interpolate(expected, mask.shape, mode="area")[0, 0]
        assert mask[inside == 0].max() == 0
        assert mask[inside == 1].mean() > 0.97


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize(
    ("color", "widths"),
    [
        (255, (40, 40, 40, 40)),
        ((250, 248, 240), (30, 120, 30, 30)),
        ((180, 30, 30), (60, 60, 0, 0)),
        (0, (0, 0, 400, 400)),
        (128, (37, 43, 51, 29)),  # not along the blocks of JPEG
    ],
)
def test_frames_and_bars_are_masked(tmp_path: Path, color, widths: tuple[int, ...], every: int, caplog) -> None:
    """Passe-partouts, prints of instant cameras, letterboxes, films on end; also if a third of the images has them."""
    shape, (top, bottom, left, right) = (640, 960), widths
    for number in range(9):
        pixels = np.full((*shape, 3), color, np.uint8)
        inside = (slice(top, 640 - bottom), slice(left, 960 - right))
        if number % every:
            inside = (slice(None), slice(None))
        pixels[inside] = scenery(number, shape)[inside]
        Image.fromarray(pixels).save(tmp_path / f"{number}.jpg", quality=60)
    found = usable_pictures(find_pictures(tmp_path), Monitor())
    assert f"{9 // every} images have borders of one colour" in caplog.text
    for number, picture in enumerate(found):
        mask = picture.read(shape).mask
        if number % every:
            assert mask is None
            continue
        outside = torch.ones(shape, dtype=torch.bool)
        outside[top : 640 - bottom, left : 960 - right] = False
        assert mask[0][outside].max() == 0
        assert mask[0][~outside].mean() > 0.92


@pytest.mark.parametrize("color", [255, 128, (40, 90, 200)])
def test_plain_backgrounds_are_not_taken_for_frames(tmp_path: Path, color, caplog) -> None:
    """A vase on a turntable, a book that is filmed from above, a band of trees between sky and snow."""
    y, x = np.mgrid[:240, :320]
    shown = {
        "vase": lambda _: (abs(x - 160) < 40 + 25 * np.sin(y / 30)) & (y > 40) & (y < 200),
        "book": lambda number: (abs(x - 160 - 3 * number) < 80) & (abs(y - 120 - 2 * number) < 60),
        "trees": lambda number: (y > 80 + number) & (y < 160 + 5 * np.sin(x / 20 + number)),
    }
    for name, mask in shown.items():
        (tmp_path / name).mkdir()
        for number in range(9):
            pixels = np.where(mask(number)[..., None], scenery(number, (240, 320)), np.uint8(color))
            Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / name / f"{number}.jpg", quality=92)
        assert all(
            picture.read(SHAPE).mask is None for picture in usable_pictures(find_pictures(tmp_path / name), Monitor())
        )
    assert "borders" not in caplog.text
