"""Draws of views and scenes: pure functions of seed and step."""

import hashlib
import json
import logging

import pytest

from vg2gt.data import DataError, SyntheticScenes
from vg2gt.data.views.sampling import ScenePool, StepSampler, ViewSampler, shares, usable_scenes


@pytest.mark.parametrize(
    ("sampler", "digest"),
    [
        (ViewSampler(8, 8, 8, 2.0, 3, 0), "149f62fda21c93face42790568336d4312d6ea6485c86e32160ff85e0c924ae9"),
        (ViewSampler(3, 6, 18, 2.0, 0, 7), "95bc3d2b832cb289bb26dd727f87274821d2dcd7d5c5047dac2e1fe5b6cfae85"),
    ],
)
def test_the_samples_of_one_dataset_never_change(sampler, digest):
    """Figures were published with them: a run of the same seed must see the same samples in later versions."""
    source = SyntheticScenes(11, num_frames=16)
    ranks = [StepSampler(source, source.scenes, sampler, 60, rank=rank, world_size=2) for rank in range(2)]
    drawn = [[[[v.scene, v.context, v.target] for v in rank.step(step)] for step in range(60)] for rank in ranks]
    assert hashlib.sha256(json.dumps(drawn).encode()).hexdigest() == digest


def test_parts_are_drawn_exactly_by_weight_and_each_in_passes():
    parts = tuple(tuple(f"{name}{i}" for i in range(count)) for name, count in (("a", 3), ("b", 40), ("c", 1)))
    pool = ScenePool(parts, shares({"a": 0.5, "b": 0.3, "c": 0.2}), seed=1)
    assert pool.shares == (5, 3, 2)
    row = [pool.scene(place) for place in range(400)]
    for start in range(0, 400, 10):
        block = [scene[0] for scene in row[start : start + 10]]
        assert [block.count(name) for name in "abc"] == [5, 3, 2]
    assert len({tuple(scene[0] for scene in row[start : start + 10]) for start in range(0, 400, 10)}) > 10
    for names in parts:
        drawn = [scene for scene in row if scene in names]
        for start in range(0, len(drawn) - len(names) + 1, len(names)):
            assert sorted(drawn[start : start + len(names)]) == sorted(names)


def test_shares_are_the_weights_exactly_and_many_digits_are_refused():
    for weights, expected in (([1, 1], (1, 1)), ([4, 2], (2, 1)), ([0.125, 1], (1, 8)), ([0.333, 0.667], (333, 667))):
        assert shares(dict(zip("ab", weights, strict=True))) == expected
    with pytest.raises(ValueError, match="fewer digits"):
        shares({"a": 0.123456789, "b": 1.0})


def test_view_sets_are_fixed_draws_per_scene():
    """Two sets per scene: over many steps every scene shows exactly two, other scenes others."""
    sampler = ViewSampler(4, 4, 4, 2.0, 2, seed=0, view_sets=2)
    drawn = {
        scene: {(v.context, v.target) for v in (sampler.views(step, scene, range(16), step) for step in range(40))}
        for scene in ("a", "b")
    }
    assert [len(sets) for sets in drawn.values()] == [2, 2]
    assert drawn["a"].isdisjoint(drawn["b"])
    with pytest.raises(ValueError, match=r"data\.view_sets"):
        ViewSampler(view_sets=0)


def test_scenes_that_are_too_short_or_cannot_be_indexed_are_left_out(caplog):
    source = SyntheticScenes(3, num_frames=5)
    lengths = {"room-000000": 3, "room-000001": 5}

    def frames(scene):
        if scene not in lengths:
            raise DataError(f"cannot read poses.txt of scene {scene}")
        return range(lengths[scene])

    source.frames = frames
    with caplog.at_level(logging.WARNING):
        assert usable_scenes(source, ViewSampler(2, 4), None) == ["room-000001"]
    assert "1 of 3 training scenes have fewer than 4 frames" in caplog.text
    assert "room-000002 is left out: cannot read poses.txt" in caplog.text
    told = r"1 scenes cannot be read.*longest has 5 that are not held out: lower .*data.target_views \(now 8\)"
    with pytest.raises(DataError, match=told):
        usable_scenes(source, ViewSampler(2, 2, target_views=8), None)


@pytest.mark.parametrize("arguments", [(4, 3), (3, 4, 8, 0.5), (2, 8, 4)])
def test_impossible_ranges_are_refused(arguments):
    with pytest.raises(ValueError, match="need"):
        ViewSampler(*arguments)
