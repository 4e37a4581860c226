"""Procedural scenes as a source: exact geometry, determinism, options, the cache."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch

from examples.worlds import Worlds
from vg2gt.data import SyntheticScenes
from vg2gt.data.synthetic.rooms import SyntheticRoom

from .conftest import SIZE
from .warping import depth_differences

LARGE = (56, 112)


def one(seed: int = 0, **options) -> Worlds:
    """A source of one scene of two small frames."""
    return Worlds(1, first_seed=seed, **{"num_frames": 2, "size": SIZE, **options})


@pytest.mark.parametrize("variant", Worlds.variants)
def test_depth_of_one_frame_predicts_the_next(variant):
    source = Worlds(1, first_seed=2, num_frames=16, size=LARGE, variant=variant)
    frames = source.load(source.scenes[0], range(4))
    differences, overlap = depth_differences(frames, 2, 3)
    assert overlap > 0.15
    assert (differences / frames.depth[3][frames.depth[3] > 0].median()).median() < 0.03


def test_a_room_keeps_its_pixels():
    """Published figures were measured on these rooms: the same version of the generator must draw the same ones."""
    stored = np.load(Path(__file__).parent / "reference" / "room-000003.npz")
    room = SyntheticRoom(3, 8, LARGE)
    frames, threads = room.render([0, 5], 1), room.render([0, 5], 3)
    for name, found in (("parts", room.world.parts), ("materials", room.world.materials)):
        np.testing.assert_allclose(found, stored[name], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(room.world_to_camera, stored["world_to_camera"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.stack([frame.depth for frame in frames]), stored["depth"], rtol=1e-6)
    # Processors that round products and sums otherwise move a pixel in ten thousand by a level or two.
    assert (np.stack([frame.image for frame in frames]) != stored["image"]).mean() < 1e-3
    for a, b in zip(frames, threads, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.array_equal(a.depth, b.depth)


def test_a_damaged_cache_file_is_made_again(tmp_path, caplog, monkeypatch):
    rooms = one(cache_dir=str(tmp_path))
    whole = rooms.load("room-000000", [0, 1])
    path = rooms.cache_file("room-000000")
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 3] ^= 0xFF
    for damaged in (content[: len(content) // 2], bytes(flipped), b""):
        path.write_bytes(damaged)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            again = rooms.load("room-000000", [0, 1])
        assert str(path) in caplog.text
        assert torch.equal(again.images, whole.images)
        assert torch.equal(again.depth, whole.depth)
        assert path.read_bytes() == content
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no temporary file is left
    monkeypatch.setattr(rooms, "_render", lambda scene: pytest.fail("rendered again"))
    assert torch.equal(rooms.load("room-000000", [1]).images[0], whole.images[1])


def test_what_decides_the_pixels_decides_the_key(tmp_path, monkeypatch):
    """Names without options stay as they were: caches and published figures hang on them."""
    cache = str(tmp_path)
    source = SyntheticScenes(1, 3, 2, (28, 56), cache_dir=cache)
    assert source.cache_file("room-000003") == tmp_path / "rooms-v1-28x56x2" / "room-000003.npz"
    shiny = SyntheticScenes(1, 3, 2, (28, 56), highlights=True, cache_dir=cache)
    assert shiny.cache_file("room-000003") == tmp_path / "rooms-highlights-v1-28x56x2" / "room-000003.npz"
    (frame,) = SyntheticRoom(3, 2, (28, 56)).render([1], 1)
    assert np.array_equal((255 * source.load("room-000003", [1]).images[0]).round().permute(1, 2, 0), frame.image)
    options = [{"size": (28, 56)}, {"num_frames": 3}, {"size": (32, 24)}, {"exposure": 1.0}, {"jpeg": (30, 90)}]
    sources = [one(3, **{"cache_dir": cache, **changed}) for changed in options]
    assert len({each.cache_file("room-000003") for each in sources}) == len(sources)
    assert source.cache_file("room-000003") == sources[0].cache_file("room-000003")
    monkeypatch.setattr(SyntheticRoom, "version", SyntheticRoom.version + 1)
    assert source.cache_file("room-000003") == tmp_path / "rooms-v2-28x56x2" / "room-000003.npz"


def test_variants_take_turns(tmp_path):
    mixed = ["room", "room", "outdoor"]
    source = Worlds(5, first_seed=1, num_frames=2, size=SIZE, variant=mixed, cache_dir=str(tmp_path))
    assert list(source.scenes) == ["room-000001", "outdoor-000002", "room-000003", "room-000004", "outdoor-000005"]
    assert (source.load("outdoor-000002", [0, 1]).depth == 0).any()
    assert (source.load("room-000003", [0, 1]).depth > 0).all()
    assert len({str(source.cache_file(scene).parent) for scene in source.scenes}) == 2  # pyright: ignore
    for name, kind in Worlds.variants.items():
        assert type(one(variant=name).scene(f"{name}-000000")) is kind


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_scenes": 0}, "num_scenes >= 1"),
        ({"variant": "orbit"}, "variant must be one of room, wide, outdoor, object, landmark, moving"),
        ({"highlights": "bright"}, "highlights must be true, false or lobes; got 'bright'"),
        ({"exposure": -1}, "exposure is a standard deviation in stops, at least 0; got -1"),
        ({"jpeg": [95, 30]}, r"jpeg must be null or a range of qualities within \[1, 100\]; got \[95, 30\]"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Worlds(**options)


def test_upright_images_have_their_field_of_view_upright():
    flat, upright = (SyntheticRoom(1, 2, size) for size in ((28, 56), (56, 28)))
    assert flat.intrinsics[0, 0] == upright.intrinsics[0, 0]
    assert upright.intrinsics[:2, 2].tolist() == [13.5, 27.5]
    assert one(1, size=(56, 28)).load("room-000001", [0]).images.shape == (1, 3, 56, 28)
    assert "upright" in one(1, size=(56, 28)).look


def test_exposure_and_jpeg_change_the_image_only(tmp_path):
    levels, ratios = [], []
    for seed in range(8):
        name, options = f"room-{seed:06d}", {"num_frames": 3, "size": (28, 56)}
        plain = one(seed, **options).load(name, [0, 1, 2])
        source = one(seed, **options, exposure=1.5, jpeg=[20, 60], cache_dir=str(tmp_path))
        taken = source.load(name, [0, 1, 2])
        assert torch.equal(plain.depth, taken.depth)
        assert torch.equal(plain.world_to_camera, taken.world_to_camera)
        assert torch.equal(source.load(name, [2]).images[0], taken.images[2])  # from the cache
        (again,) = source.scene(name).render([2], 1)
        assert np.array_equal((255 * taken.images[2]).round().permute(1, 2, 0), again.image)
        light = taken.images.mean((1, 2, 3))
        levels.append(float(light.mean()))
        ratios.append(float(light.max() / light.min()))
    assert min(levels) < 0.25
    assert max(levels) > 0.8
    assert np.median(ratios) < 1.4  # frames of one scene are alike
