"""Which mask file belongs to which image: nested, flat, and names that occur twice."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vg2gt.data.base import DataError
from vg2gt.data.sources.masks import mask_beside
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.inputs.pictures import find_pictures


def _put(*files: Path, hidden: str = "") -> None:
    """Writes images, or masks of which one half is black."""
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((24, 32), 255, np.uint8)
        pixels[:, {"left": slice(0, 16), "right": slice(16, 32)}.get(hidden, slice(0))] = 0
        Image.fromarray(pixels).convert("L" if file.suffix.lower() == ".png" else "RGB").save(file)


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        ("1.jpg", "masks/1.png"),
        ("front/1.jpg", "masks/front/1.png"),
        ("front/1.jpg", "masks/front/1.jpg.png"),
        ("front/1.jpg", "front/masks/1.png"),
        ("images/front/1.jpg", "masks/front/1.png"),
        ("images/front/1.jpg", "images/masks/front/1.png"),
        ("drone/DCIM/100MEDIA/1.jpg", "masks/drone/DCIM/100MEDIA/1.png"),
        ("front/1.jpg", "masks/1.png"),  # no other folder of photographs has an image of that name
        ("images/1.jpg", "masks/1.png"),  # images_4 holds the same image
        ("images/1.jpg", "Masks/1.PNG"),
        ("images/a.JPG", "masks/A.jpg.Png"),
        ("1.jpg", "1_MASK.PNG"),
        ("1.jpg", "mask/1.tif"),
        ("1.jpg", "masks/1_mask.png"),
        ("1.jpg", "1_mask.png"),  # as drone programs have it
        ("front/1.jpg", "front/1.jpg.mask.png"),
    ],
)
def test_where_masks_are(tmp_path: Path, image: str, mask: str) -> None:
    _put(*(tmp_path / name for name in (image, mask, "images_4/1.jpg", "thumbs/1.jpg", "depth/1.png")))
    assert mask_beside(tmp_path / image) == tmp_path / mask


def test_masks_next_to_their_images_are_no_photographs(tmp_path: Path, caplog) -> None:
    names = ("1.jpg", "2.jpg", "1_MASK.PNG", "2.mask.png", "face_mask.png", "1_mask_2.jpg")
    _put(*(tmp_path / name for name in names), hidden="left")
    for given in (tmp_path, [tmp_path / name for name in names]):
        found = find_pictures(given)
        assert sorted(picture.name for picture in found) == ["1", "1_mask_2", "2", "face_mask"]
        masks = {picture.name: picture.read((24, 32)).mask for picture in found}
        assert [name for name, mask in masks.items() if mask is not None] == ["1", "2"]
        assert "2 of 4 images have no mask" in caplog.text


@pytest.mark.parametrize(("orientation", "size", "said"), [(3, (32, 24), 1), (6, (32, 24), 0), (6, (32, 32), 1)])
def test_masks_whose_shape_does_not_tell_their_direction(tmp_path: Path, caplog, orientation, size, said) -> None:
    """As stored or upright: only a quarter turn of a photograph that is not square changes its shape."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", size).save(tmp_path / "1.jpg", exif=exif)
    (tmp_path / "masks").mkdir()
    Image.new("L", size).save(tmp_path / "masks" / "1.png")
    find_pictures(tmp_path)
    assert caplog.text.count("taken as those of the upright photographs: ") == said


@pytest.mark.parametrize(
    ("images", "mask", "better"),
    [
        (("front/1.jpg", "back/1.jfif"), "masks/1.png", "masks/front/1.jpg.png"),
        (("images/front/1.jpg", "images/back/1.jpg"), "masks/1.png", "masks/front/1.jpg.png"),
        (("1.jpg", "1.tif"), "masks/1.png", "masks/1.jpg.png"),
    ],
)
def test_a_mask_of_two_images_is_refused(tmp_path: Path, images: tuple[str, str], mask: str, better: str) -> None:
    _put(*(tmp_path / name for name in images), tmp_path / mask)
    with pytest.raises(DataError, match=f"name the masks {better} and so on"):
        mask_beside(tmp_path / images[0])
    _put(tmp_path / better)
    assert mask_beside(tmp_path / images[0]) == tmp_path / better


def test_cameras_of_transforms_with_nested_and_flat_masks(tmp_path: Path, caplog) -> None:
    names = ("front/1.jpg", "back/1.JPG")
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 32, "h": 24, "fl_x": 30, "frames": frames}))
    _put(*(tmp_path / name for name in (*names, "masks/1.png")))
    with pytest.raises(DataError, match="may be the mask of"):
        Nerfstudio(str(tmp_path)).load(tmp_path.name, [0, 1])
    (tmp_path / "masks" / "1.png").unlink()
    _put(tmp_path / "masks" / "front" / "1.png", hidden="left")
    _put(tmp_path / "masks" / "back" / "1.png", hidden="right")
    source = Nerfstudio(str(tmp_path))
    mask = source.load(source.scenes[0], [0, 1]).mask
    assert mask is not None
    assert sorted(each[0, ::31].tolist() for each in mask) == [[0, 1], [1, 0]]  # back, front
    assert not caplog.text
    given = find_pictures([tmp_path / "front", tmp_path / "back"])
    masks = [picture.read((24, 32)).mask for picture in given]
    assert [None if each is None else each[0, 0, ::31].tolist() for each in masks] == [[0, 1], [1, 0]]


def test_images_without_the_mask_that_others_name(tmp_path: Path, caplog) -> None:
    """They have those of ``masks/``, and what has none is said."""
    frames = [{"file_path": f"{i}.jpg", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    frames[0]["mask_path"] = "hidden/a.png"
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 32, "h": 24, "fl_x": 30, "frames": frames}))
    _put(*(tmp_path / f"{i}.jpg" for i in range(3)))
    _put(tmp_path / "hidden" / "a.png", hidden="left")
    for masks in (1, 2):
        caplog.clear()
        mask = Nerfstudio(str(tmp_path)).load(tmp_path.name, [0, 1, 2]).mask
        assert mask is not None
        assert [each[0, ::31].tolist() for each in mask] == [[0, 1], [1, 1] if masks == 1 else [1, 0], [1, 1]]
        lacking = "1.jpg, 2.jpg" if masks == 1 else "2.jpg"
        assert f"{4 - masks - 1} of 3 images have no mask" in caplog.text
        assert caplog.text.strip().endswith(lacking)
        _put(tmp_path / "masks" / "1.png", hidden="right")
