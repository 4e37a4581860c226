"""Several datasets as one: names, weights, units, places, selection, errors."""

from collections import Counter
from functools import partial

import pytest

from vg2gt.data import DataError, Mixture, RGBDFolder, SyntheticScenes
from vg2gt.data.views.sampling import ViewSampler, usable_scenes

from .conftest import SIZE, module_of


class OneHall(SyntheticScenes):
    def place(self, scene: str) -> str:
        return "hall"


def _mixture(cache: str | None = None, weights=(3, 1), **options) -> Mixture:
    parts = {
        "rooms": partial(SyntheticScenes, 4, num_frames=6, size=SIZE, cache_dir=cache),
        "other": OneHall(2, first_seed=50, num_frames=6, size=SIZE, cache_dir=cache),
    }
    return Mixture(parts, dict(zip(parts, weights, strict=True)), **options)


def test_scenes_of_all_parts_take_turns():
    mixture = _mixture()
    assert list(mixture.scenes)[:5] == [
        "rooms/room-000000", "other/room-000050", "rooms/room-000001", "other/room-000051", "rooms/room-000002",
    ]  # fmt: skip
    assert mixture.place("other/room-000051") == "other/hall"
    assert mixture.place("rooms/room-000001") == "rooms/room-000001"
    assert list(mixture.frames("other/room-000050")) == list(range(6))
    assert list(mixture.held_out("other/room-000050")) == []


def test_batches_hold_the_parts_by_weight(rooms):
    mixture = _mixture(str(rooms.cache_dir))
    module = module_of(rooms, train=mixture, max_views=2, max_images=8, steps_per_epoch=3)
    seen = Counter()
    for batch in module.train_dataloader():
        seen.update(name.partition("/")[0] for name in batch.scene)
        direct = mixture.load(batch.scene[0], batch.frame_ids[0].tolist())
        assert float((direct.images - batch.images[0]).abs().max()) < 1e-6
    assert seen == {"rooms": 9, "other": 3}


def test_a_mixture_of_mixtures_would_ignore_weights() -> None:
    inner = Mixture({"a": SyntheticScenes(1), "b": SyntheticScenes(1)}, {"a": 9, "b": 1})
    with pytest.raises(ValueError, match="inner is a mixture itself"):
        Mixture({"inner": inner, "c": SyntheticScenes(1)}, {"inner": 1, "c": 1})


def test_missing_roots_are_named_unless_their_weight_is_zero(tmp_path):
    parts, weights = {"rooms": SyntheticScenes(2), "disk": RGBDFolder}, {"rooms": 1, "disk": 1}
    assert Mixture(parts, {"rooms": 1, "disk": 0}, disk_root=None).sources.keys() == {"rooms"}
    with pytest.raises(FileNotFoundError, match=r"data\.disk_root is not set.*data\.weights\.disk=0"):
        Mixture(parts, weights, disk_root=None)
    with pytest.raises(FileNotFoundError, match=r"part disk of the mixture \(data\.disk_root\).*nowhere"):
        Mixture(parts, weights, disk_root=str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match=r"part disk of the mixture \(data\.disk_root\).*no scene"):
        Mixture(parts, weights, disk_root=str(tmp_path))


def test_arguments_reach_their_part():
    parts = {"a": partial(SyntheticScenes, 1), "b": partial(SyntheticScenes, 1)}
    mixture = Mixture(parts, {"a": 1, "b": 1}, num_frames=5, b_first_seed=8)
    assert list(mixture.scenes) == ["a/room-000000", "b/room-000008"]
    assert len(mixture.frames("a/room-000000")) == len(mixture.frames("b/room-000008")) == 5


def test_a_part_without_a_usable_scene_is_an_error():
    parts = {"long": SyntheticScenes(2, num_frames=9), "short": SyntheticScenes(2, num_frames=3)}
    mixture = Mixture(parts, {"long": 1, "short": 1})
    with pytest.raises(DataError, match="none of 2 training scenes of short has 4 frames"):
        usable_scenes(mixture, ViewSampler(4, 4), None)


@pytest.mark.parametrize(
    "weights", [{"a": 1}, {"a": 1, "b": 1, "c": 1}, {"a": 0, "b": 0}, {"a": -1, "b": 2}, {"a": float("nan"), "b": 1}]
)
def test_weights_must_fit_the_parts(weights):
    with pytest.raises(ValueError, match="weight"):
        Mixture({"a": SyntheticScenes(1), "b": SyntheticScenes(1)}, weights)
