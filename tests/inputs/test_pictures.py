from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from vg2gt.inputs import pictures
from vg2gt.inputs.distinct import with_unique_names
from vg2gt.inputs.inputs import load_views, working_size
from vg2gt.inputs.pictures import Picture, find_pictures, shrunk
from vg2gt.io import read_video, video, write_video
from vg2gt.monitor import Monitor


def _views(images):
    return load_views(find_pictures(images), (84, 112), Monitor())


def test_photographs_of_all_sizes_come_upright_in_the_order_of_their_numbers(photos: Path, frames) -> None:
    views = _views(photos)
    assert [picture.name for picture in find_pictures(photos)] == ["IMG_8", "IMG_9", "IMG_10", "IMG_11"]
    assert torch.equal(views.images[0], frames.images[0])
    for i in (1, 2):  # JPEG, resized or turned
        assert (views.images[i] - frames.images[i]).abs().mean() < 0.03
    assert views.hints.cameras is None
    assert views.hints.frame_ids.tolist() == [list(range(4))]


def test_a_long_video_may_begin_in_the_middle(tmp_path: Path, monkeypatch) -> None:
    """As one that was cut without coding it again: what comes before the next whole frame cannot be decoded."""
    av = pytest.importorskip("av")
    noise = np.random.default_rng(0).integers(0, 256, (32, 64, 3)).astype(np.uint8)
    with av.open(str(tmp_path / "cut.mkv"), "w") as container:
        stream = container.add_stream("libx264", 10, {"g": "6", "sc_threshold": "0", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        images = [av.VideoFrame.from_ndarray(np.roll(noise, 2 * i, 1), "rgb24") for i in range(20)]
        packets = [packet for image in (*images, None) for packet in stream.encode(image)]
        container.mux(packets[2:])
    monkeypatch.setattr(pictures, "IN_MEMORY", 2)
    found = find_pictures(tmp_path / "cut.mkv", max_images=6)
    assert len(found) > 3
    assert found[0].read((32, 64)).images.shape == (1, 3, *found[0].size)


def test_order_and_mixture_of_arguments_are_kept(photos: Path, frames) -> None:
    given = [frames.images[3], photos / "IMG_9.jpg", Image.open(photos / "IMG_10.jpg"), frames.images[:2]]
    views = _views(given)
    assert [picture.name for picture in find_pictures(given)] == [
        "image-000",
        "IMG_9",
        *(f"image-00{i}" for i in (1, 2, 3)),
    ]
    assert (views.images[2] - frames.images[2]).abs().mean() < 0.03  # the Pillow image's EXIF data count too
    assert torch.allclose(views.images[[0, 3, 4]], frames.images[[3, 0, 1]], atol=1 / 500)


def test_frames_of_a_video(tmp_path: Path) -> None:
    frames = [np.zeros((20, 70, 3), np.uint8) for _ in range(70)]
    for i, frame in enumerate(frames):
        frame[:, :i] = 255
    path = write_video(tmp_path / "clip.gif", frames)
    assert len(find_pictures(path)) == 32
    chosen = find_pictures(path, max_images=3)
    numbers = [int(p.name.removeprefix("clip-")) for p in chosen]
    assert [number * 3 // 70 for number in numbers] == [0, 1, 2]  # one of each third
    assert chosen[2].read((14, 14)).images.mean().item() == pytest.approx(numbers[2] / 70, abs=0.02)
    mixed = find_pictures([frames[0], path, frames[1]], max_images=3)
    assert [p.name for p in mixed] == ["image-000", chosen[1].name, "image-001"]


@pytest.mark.parametrize("kept", [100, 2])
def test_the_sharpest_frames_of_a_video_are_taken(tmp_path: Path, monkeypatch, kept: int) -> None:
    pytest.importorskip("av")
    texture = np.random.default_rng(0).integers(0, 256, (96, 160, 3)).astype(np.float32)
    texture = ndimage.uniform_filter(texture, (3, 3, 0))
    sharp = {3, 4, 13, 21, 34}
    frames = []
    for number in range(36):
        moved = np.roll(texture, 4 * number, 1)
        smeared = ndimage.uniform_filter(moved, (0, 9, 0))  # the camera pans: rows stay as sharp as they are
        frames.append((moved if number in sharp else smeared).clip(0, 255).astype(np.uint8))
    path = write_video(tmp_path / "pan.mp4", frames)
    monkeypatch.setattr(pictures, "IN_MEMORY", kept)
    found = find_pictures(path, max_images=4)
    assert [p.name for p in found][1:] == ["pan-000013", "pan-000021", "pan-000034"]
    assert found[0].name in ("pan-000003", "pan-000004")
    for picture in found:
        number = int(picture.name.removeprefix("pan-"))
        shown = picture.read((96, 160)).images[0].permute(1, 2, 0).numpy() * 255
        assert np.abs(shown - frames[number]).mean() < 12
    monkeypatch.setattr(pictures, "MOST_FRAMES", 3)
    assert len(find_pictures(path, max_images=30)) == 3


def test_a_reduced_photograph_fits_its_camera() -> None:
    ramp = np.tile(np.arange(0, 250, 2, np.uint8)[:, None], (81, 1, 3))
    small = shrunk(ramp, (20, 31))[0, :, 0].astype(float) / 2
    expected = (np.arange(len(small)) + 0.5) * 125 / len(small) - 0.5
    assert np.abs(small - expected)[1:-1].max() < 0.3  # a quarter from rounding


def test_numbers_make_names_unique() -> None:
    pictures = [Picture(name, (8, 8), lambda size: None) for name in ("a", "a", "a-000")]  # type: ignore[arg-type]
    assert [each.name for each in with_unique_names(pictures)] == ["a-001", "a-002", "a-000"]
    twins = [Picture(name, (8, 8), lambda size: None) for name in ("A", "a", "B", "A-000")]  # type: ignore[arg-type]
    assert [each.name for each in with_unique_names(twins)] == ["A-001", "a-002", "B", "A-000"]


def test_working_size() -> None:
    for sizes, device, wanted, expected in (
        ([(600, 800)] * 3, "cpu", None, (294, 392)),
        ([(600, 800)] * 49, "cpu", None, (210, 280)),  # many
        ([(600, 800)], "cpu", 140, (112, 140)),
        ([(600, 800)], "cpu", (28, 56), (28, 56)),
        ([(600, 800), (800, 600)], "cpu", None, (392, 392)),
        ([(800, 600)], "cuda", None, (518, 392)),
        ([(60, 50)], "cpu", None, (56, 42)),  # not more than there is
    ):
        assert working_size(sizes, 14, device, wanted) == expected
    for size, said in (((30, 60), "try 28x56"), (10, "smaller than one patch")):
        with pytest.raises(ValueError, match=said):
            working_size([(60, 50)], 14, "cpu", size)


@pytest.mark.parametrize("suffix", ["webp", "png"])
def test_files_of_several_pictures_are_named(tmp_path: Path, suffix: str, caplog) -> None:
    pages = [Image.fromarray(np.full((8, 8, 3), 90 * i, np.uint8)) for i in range(3)]
    pages[0].save(tmp_path / f"a.{suffix}", save_all=True, append_images=pages[1:])
    pages[0].save(tmp_path / "b.png")
    assert len(find_pictures(tmp_path)) == 2
    assert f"1 files hold several pictures, of which the first is used: a.{suffix}" in caplog.text


@pytest.mark.parametrize("name", ["IMG.HEIC", "IMG.jpg"])
def test_heic_names_its_package(tmp_path: Path, monkeypatch, name: str) -> None:
    """Known by its content: a cloud's ``.jpg`` that is HEIC was "not an image"."""
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "other.png")
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for given in (tmp_path, tmp_path / name):
        with pytest.raises(ImportError, match=f"{name} is HEIC: pip install pillow-heif, or save it as JPEG"):
            find_pictures(given)


def test_what_is_no_image() -> None:
    flat, counts, bright = np.zeros((4, 5), np.uint8), np.zeros((4, 5, 3), np.int32), torch.full((3, 4, 5), 2.0)
    for item, said in ((flat, r"shape \[4, 5\]"), (counts, "uint8"), (bright, r"\[0, 1\]"), (7, "int")):
        with pytest.raises(ValueError, match=said):
            find_pictures([item])


def test_a_long_video_is_decoded_when_it_is_read(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("av")
    frames = [np.full((32, 48, 3), 7 * i, np.uint8) for i in range(30)]
    path = write_video(tmp_path / "walk.mp4", frames)
    whole = find_pictures(path, max_images=15)
    monkeypatch.setattr(pictures, "IN_MEMORY", 10)
    reads = []
    monkeypatch.setattr(video, "read_video", lambda *inputs: reads.append(inputs) or read_video(*inputs))
    lazy = find_pictures(path, max_images=15)
    assert [(p.name, p.size) for p in lazy] == [(p.name, p.size) for p in whole]
    for i in (0, 1, 5, 14, 3):
        assert torch.equal(lazy[i].read((32, 48)).images, whole[i].read((32, 48)).images)
    assert len(reads) == 2  # once in order, once again for the frame before


def test_what_masks_of_objects_hide_looks_as_if_transparent(tmp_path: Path) -> None:
    """Depth of the object was found by the room that its masks hid; before a scene that goes on, nothing changes."""
    pixels = np.random.default_rng(0).integers(0, 255, (56, 84, 3), np.uint8)
    shown = {"object": np.zeros((56, 84), np.uint8), "transient": np.full((56, 84), 255, np.uint8)}
    shown["object"][10:40, 20:60], shown["transient"][10:40, 20:60] = 255, 0
    for kind, mask in shown.items():
        for folder in (f"{kind}-alpha", f"{kind}-file", f"{kind}-file/masks"):
            (tmp_path / folder).mkdir()
        Image.fromarray(np.dstack([pixels, mask])).save(tmp_path / f"{kind}-alpha" / "1.png")
        Image.fromarray(pixels).save(tmp_path / f"{kind}-file" / "1.png")
        Image.fromarray(mask).save(tmp_path / f"{kind}-file" / "masks" / "1.png")
    found = {
        folder.name: load_views(find_pictures(folder), (56, 84), Monitor()) for folder in sorted(tmp_path.iterdir())
    }
    assert torch.equal(found["object-file"].images, found["object-alpha"].images)
    assert torch.equal(found["object-file"].mask, found["object-alpha"].mask)
    plain = torch.from_numpy(pixels).permute(2, 0, 1) / 255
    torch.testing.assert_close(found["transient-file"].images[0], plain)
