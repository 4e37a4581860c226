"""360 degree panoramas: with and without metadata, whole and in part, and as cube faces."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.inputs.panoramas import FACES, continues
from vg2gt.inputs.pictures import find_pictures
from vg2gt.io import write_video

SIZE = (256, 512)
NOTE = '<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular" {}/></x:xmpmeta>'
PART = NOTE.format(
    'GPano:FullPanoWidthPixels="1024" GPano:FullPanoHeightPixels="512" GPano:CroppedAreaLeftPixels="256" '
    'GPano:CroppedAreaTopPixels="160" GPano:CroppedAreaImageWidthPixels="512"'
)


def look(rays: np.ndarray) -> np.ndarray:
    """Colours ``[..., 3]`` in [0, 255] of directions (x right, y down, z forward), with detail."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    waves = np.sin(unit @ np.array([[7.0, -5, 2], [4, 9, -6], [-3, 6, 8]]).T * 2 + [0, 1, 2])
    return 127.5 + 110 * waves


def sphere(size=SIZE) -> np.ndarray:
    longitude = ((np.arange(size[1]) + 0.5) / size[1] - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(size[0]) + 0.5) / size[0]) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    rays = np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], -1)
    return look(rays).round().astype(np.uint8)


def expected_face(name: str, side: int) -> np.ndarray:
    across = ((np.arange(side) + 0.5) / side - 0.5) * 2  # focal length: half a side
    x, y = np.meshgrid(across, across)
    return look(np.stack([x, y, np.ones_like(x)], -1) @ np.array(FACES[name], float))


@pytest.mark.parametrize("note", [NOTE.format(""), None], ids=["XMP", "no XMP"])
def test_a_panorama_becomes_six_pinhole_images(tmp_path: Path, note: str | None, caplog) -> None:
    xmp = {} if note is None else {"xmp": note.encode()}
    Image.fromarray(sphere()).save(tmp_path / "hall.png")
    if note is not None:
        Image.fromarray(sphere()).save(tmp_path / "hall.jpg", quality=98, subsampling=0, **xmp)
        (tmp_path / "hall.png").unlink()
    pictures = find_pictures(tmp_path)
    assert [picture.name for picture in pictures] == [f"hall-{name}" for name in FACES]
    assert "1 images are 360 degree panoramas" in caplog.text
    for picture, name in zip(pictures, FACES, strict=True):
        assert (picture.size, picture.focal, picture.path) == ((128, 128), 64, None)
        found = picture.read(picture.size).images[0].permute(1, 2, 0).numpy() * 255
        np.testing.assert_allclose(found, expected_face(name, 128), atol=4 if note is None else 14)
        assert np.abs(found - expected_face(name, 128)).mean() < 1.5


def test_faces_turn_right_handed_and_share_their_edges() -> None:
    for axes in FACES.values():
        assert np.linalg.det(np.array(axes, float)) == 1
    front, right = expected_face("front", 200), expected_face("right", 200)
    assert np.abs(front[:, -1] - right[:, 0]).max() < 15  # neighbours in the scene


def test_a_part_of_a_panorama_is_masked_where_it_shows_nothing(tmp_path: Path) -> None:
    whole = sphere((512, 1024))
    Image.fromarray(whole[160:352, 256:768]).save(tmp_path / "wall.jpg", quality=98, subsampling=0, xmp=PART.encode())
    pictures = {picture.name: picture for picture in find_pictures(tmp_path / "wall.jpg")}
    assert set(pictures) == {"wall-front", "wall-right", "wall-left"}  # 90 degrees to either side, 34 up and down
    front = pictures["wall-front"].read((256, 256))
    inside = front.mask[0].numpy() > 0.5
    assert inside[:, 128].mean() == pytest.approx(np.tan(np.radians(33.75)), abs=0.02)
    assert not inside[0].any()
    found = front.images[0].permute(1, 2, 0).numpy() * 255
    assert np.abs(found - expected_face("front", 256))[inside].mean() < 2
    right = pictures["wall-right"].read((256, 256)).mask[0].numpy() > 0.5
    assert right[:, :127].mean() > 0.5
    assert not right[:, 129:].any()


def test_masks_of_panoramas_are_cut_alike(tmp_path: Path) -> None:
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, :256] = 0  # the left half: left of the front
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "hall.png")
    Image.fromarray(sphere()).save(tmp_path / "hall.png")
    masks = {picture.name: picture.read(picture.size).mask for picture in find_pictures(tmp_path)}
    assert masks["hall-left"].max() == 0
    assert masks["hall-right"] is None or masks["hall-right"].min() > 0.999
    assert masks["hall-front"][0, :, :60].max() == 0
    assert masks["hall-front"][0, :, 68:].min() > 0.999


def test_photographs_of_this_shape_are_no_panoramas(tmp_path: Path) -> None:
    """Also those of a horizon, whose borders are alike, and plain ones."""
    noise = np.random.default_rng(0)
    cut = sphere((512, 1024))[128:256, 100:356]
    horizon = np.tile(np.linspace(0, 255, 128)[:, None, None], (1, 256, 3)) + noise.normal(0, 3, (128, 256, 3))
    blinds = np.tile(noise.uniform(0, 255, (128, 1, 3)), (1, 256, 1))
    for name, pixels in {
        "cut": cut,
        "horizon": horizon,
        "blinds": blinds,
        "plain": np.full((128, 256, 3), 9.0),
    }.items():
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(tmp_path / f"{name}.png")
        assert not continues(tmp_path / f"{name}.png")
    assert [picture.size for picture in find_pictures(tmp_path)] == [(128, 256)] * 4


def test_videos_of_360_degree_cameras_are_cut_alike(tmp_path: Path, caplog) -> None:
    """Their frames were taken for photographs twice as wide as high."""
    pytest.importorskip("av")
    path = write_video(tmp_path / "walk.mp4", [np.roll(sphere(), 16 * i, 1) for i in range(6)])
    pictures = find_pictures(path, max_images=12)
    assert [picture.name for picture in pictures] == [
        f"walk-{n}-{name}" for n in ("000000", "000005") for name in FACES
    ]
    assert f"{path} is a 360 degree video" in caplog.text
    for picture, name in zip(pictures, FACES, strict=False):
        assert (picture.size, picture.focal, picture.path, picture.container) == ((128, 128), 64, None, path)
        found = picture.read(picture.size).images[0].permute(1, 2, 0).numpy() * 255
        assert np.abs(found - expected_face(name, 128)).mean() < 8  # of H.264
    caplog.clear()
    write_video(path, [sphere((512, 1024))[128:256, 100 + i : 356 + i] for i in range(6)])
    assert [picture.size for picture in find_pictures(path)] == [(128, 256)] * 6
    assert not caplog.text
