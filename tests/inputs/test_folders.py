"""Photographs in subfolders are taken, what is not read is named."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

from tests.inputs.test_given_cameras import NAMES, put_cameras
from vg2gt.inputs.cameras import pictures_for
from vg2gt.inputs.pictures import find_pictures


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = sum(path.as_posix().encode())
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (16, 24, 3), np.uint8)).save(path)


def test_subfolders_are_taken_together_and_said(tmp_path: Path, caplog) -> None:
    for name in ("top/2.jpg", "top/10.jpg", "top/more/1.jpg", "sides/phone/1.jpg", "sides/drone/DCIM/100MEDIA/1.jpg"):
        put(tmp_path / name)
    assert [picture.name for picture in find_pictures(tmp_path / "top")] == ["2", "10", "1"]
    assert f"several folders in {tmp_path / 'top'} are taken together: . (2), more (1)" in caplog.text
    assert [picture.name for picture in find_pictures(tmp_path / "sides")] == ["1-000", "1-001"]
    assert "taken together: drone/DCIM/100MEDIA (1), phone (1)" in caplog.text


def test_what_is_no_photograph_is_not_taken(tmp_path: Path, caplog) -> None:
    """Masks, depth, thumbnails, reduced copies, and what the command has written there."""
    others = ("masks", "depth", "depth_images", ".thumbnails", "images_4", "sparse", "out", "out/sfm/images")
    for name in ("a.jpg", "b.jpg", *(f"{other}/a.jpg" for other in others)):
        put(tmp_path / name)
    (tmp_path / "out" / "report.json").write_text("{}")
    assert [picture.path for picture in find_pictures(tmp_path)] == [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    assert "taken together" not in caplog.text
    for name in ("cam1/d.jpg", "cam2/d.jpg", "c.jpg"):
        put(tmp_path / "images" / name)
    assert len(find_pictures(tmp_path)) == 3
    assert f"images are taken from {tmp_path / 'images'}; 2 next to it are ignored" in caplog.text


def test_folders_of_masks_of_other_names(tmp_path: Path, caplog) -> None:
    """Masks in ``images_masks/``, as many as there are photographs, were taken instead of these without a word."""
    for name in ("images/1.jpg", "images/2.jpg", "images_masks/1.png", "images_masks/2.png", "Segmentation/1.png"):
        put(tmp_path / name)
    assert {picture.path for picture in find_pictures(tmp_path)} == {tmp_path / f"images/{n}.jpg" for n in (1, 2)}
    assert f"not used as masks: {tmp_path / 'Segmentation'}, {tmp_path / 'images_masks'} (" in caplog.text


def test_files_that_are_not_read_are_named(tmp_path: Path, caplog, monkeypatch) -> None:
    put(tmp_path / "a.jpg")
    for name in ("b.dng", "c.EXR", "d.gif", "e.mp4", "more/f.nef", "notes.txt", ".g.dng"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"1")
    put(tmp_path / "elsewhere" / "images" / "1.jpg")
    (tmp_path / "linked").symlink_to(tmp_path / "elsewhere" / "images")
    (tmp_path / "elsewhere" / "report.json").write_text("{}")  # so that it is not searched itself
    for name in ("g.MTS", "h.3gp"):
        (tmp_path / name).write_bytes(b"1")
    put(tmp_path / "a_depth.png")
    (tmp_path / "i.jpg").symlink_to(tmp_path / "no longer there.jpg")
    assert len(find_pictures(tmp_path)) == 1
    named = "a_depth.png, b.dng, c.EXR, d.gif, e.mp4, g.MTS, h.3gp, i.jpg, linked/ (a link), more/f.nef"
    assert f"not read: {named} (save" in caplog.text
    for name in ("a.jpg", "a_depth.png"):
        (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=r"no images in .*; not read: b\.dng, c\.EXR"):
        find_pictures(tmp_path)
    put(tmp_path / "dense" / "1.jpg")
    with pytest.raises(ValueError, match=r"not searched, by their names: dense/, elsewhere/"):
        find_pictures(tmp_path)
    monkeypatch.setattr("vg2gt.inputs.folders.features.check", lambda name: False)
    (tmp_path / "h.avif").write_bytes(b"1")
    put(tmp_path / "a.jpg")
    assert len(find_pictures(tmp_path)) == 1
    assert "h.avif" in caplog.text


def test_maps_of_blender_and_what_is_not_downloaded(tmp_path: Path, caplog) -> None:
    """A cloud leaves ``.IMG_1.jpg.icloud`` of a photograph that is not on the disk: it was missing without a word."""
    for name in ("r_0.png", "r_0_depth_0001.png", "r_0_normal.png", "r_normal_0002.png"):
        put(tmp_path / name)
    for name in (".r_1.png.icloud", "r_2.png.crdownload"):
        (tmp_path / name).write_bytes(b"1")
    assert [picture.name for picture in find_pictures(tmp_path)] == ["r_0", "r_normal_0002"]
    assert "not downloaded completely: .r_1.png.icloud, r_2.png.crdownload" in caplog.text
    assert "not read: r_0_depth_0001.png, r_0_normal.png (" in caplog.text


def test_archives_are_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "photos.zip").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"photos\.zip is an archive: unpack it"):
        find_pictures(tmp_path / "photos.zip")


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow reads no AVIF")
def test_avif(tmp_path: Path) -> None:
    put(tmp_path / "a.avif")
    put(tmp_path / "b.AVIF")
    assert [picture.size for picture in find_pictures(tmp_path)] == [(16, 24)] * 2


def test_photographs_below_without_cameras_are_named(folder: Path, frames, model, caplog) -> None:
    put_cameras(folder, frames)
    put(folder / "images" / "more" / "extra.png")
    with pictures_for(model, folder) as pictures:
        assert len(pictures) == len(NAMES)
    assert "has no cameras for 1 images, which are left out: more/extra.png" in caplog.text


def test_depth_of_a_recording_is_not_taken_for_photographs(frames, ready, tmp_path: Path, caplog) -> None:
    """7-Scenes: a folder of frame-N.color.png, .depth.png and .pose.txt."""
    for number in range(4):
        stem = tmp_path / f"frame-{number:06d}"
        image = (frames.images[number].permute(1, 2, 0) * 255).byte().numpy()
        Image.fromarray(image).save(f"{stem}.color.png")
        Image.fromarray((frames.depth[number] * 1000).numpy().astype(np.uint16)).save(f"{stem}.depth.png")
        pose = np.linalg.inv(frames.world_to_camera[number].double().numpy())
        np.savetxt(f"{stem}.pose.txt", pose)
    np.savetxt(tmp_path / "camera-intrinsics.txt", frames.intrinsics[0].numpy())
    with pictures_for(ready.model, tmp_path) as pictures:
        assert len(pictures) == 4
    assert "has no cameras" not in caplog.text
