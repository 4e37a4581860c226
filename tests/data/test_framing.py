"""Framing: sizes, zoom and windows are functions of the step, and intrinsics follow the pixels."""

import pytest
import torch

from vg2gt.data import Frames, SceneDataModule, SyntheticScenes
from vg2gt.data.framing import Framing, FramingSampler
from vg2gt.data.views.sampling import StepSampler, ViewSampler
from vg2gt.geometry.cameras import ray_directions

from .conftest import assert_same_batches, module_of


def _rays(height: int = 60, width: int = 80, sparse: bool = False) -> Frames:
    """Frames whose colours are the rays' directions and whose depth is the ray's x: pixels tell where they are."""
    intrinsics = torch.tensor([[90.0, 0, 38.2], [0, 85.0, 30.9], [0, 0, 1]])[None]
    rays = ray_directions(intrinsics, (height, width))[0]
    images = (rays * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.5, 0.5, 0.0])).permute(2, 0, 1)[None]
    return Frames(images, rays[None, ..., 0] + 1, torch.eye(4)[None], intrinsics, sparse)


@pytest.mark.parametrize(
    "framing",
    [
        Framing((28, 56)),
        Framing((28, 56), zoom=1.3),
        Framing((42, 28), zoom=1.2, place=(0.0, 0.99)),
        Framing((42, 28), place=(0.4, 0.2)),
        Framing((28, 56), fit="pad"),
        Framing((70, 70), fit="pad"),
        Framing((98, 126), zoom=1.1, place=(0.9, 0.1)),
    ],
)
def test_pixels_and_intrinsics_agree(framing):
    framed = framing.apply(_rays())
    assert framed.images.shape[-2:] == framed.depth.shape[-2:] == framing.size
    expected = ray_directions(framed.intrinsics, framing.size)[0]
    inside = framed.images[0, 2] > 0.499  # black: padded
    inside[1:-1, 1:-1] &= (inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:]).clone()
    inside[[0, -1]] = inside[:, [0, -1]] = False
    assert inside.float().mean() > 0.4
    colors = framed.images[0, :2].permute(1, 2, 0) - 0.5
    assert float((colors - expected[..., :2]).abs()[inside].max()) < 0.1 / 85  # 0.1 pixels
    assert float((framed.depth[0] - 1 - expected[..., 0]).abs()[inside].max()) < 0.51 / 90  # the nearest pixel
    if framing.fit == "pad":
        assert not framed.depth[0][framed.images[0, 2] == 0].any()


def test_sparse_depth_follows_a_zoom():
    frames = _rays(sparse=True)
    frames.depth[:, ::2] = 0
    framed = Framing((42, 56), zoom=1.5, place=(0.3, 0.6)).apply(frames)
    expected = ray_directions(framed.intrinsics, (42, 56))[0, ..., 0]
    valid = framed.depth[0] > 0
    assert 0 < valid.float().mean() < 0.6
    assert float((framed.depth[0] - 1 - expected).abs()[valid].max()) < 0.51 / 90


def test_drawn_sizes_keep_the_area_and_stay_in_range():
    sampler = FramingSampler((224, 448), aspect=(0.33, 1.0), seed=4)
    sizes = {sampler.size(step) for step in range(300)}
    assert len(sizes) > 10
    for height, width in sizes:
        assert height % 14 == width % 14 == 0
        assert 0.3 < height / width < 1.05
        assert abs(height * width / (224 * 448) - 1) < 0.08
        assert height <= sampler.largest[0]
        assert width <= sampler.largest[1]


def test_a_steps_scenes_share_a_size_on_all_devices_and_differ_in_zoom_and_window():
    source = SyntheticScenes(40, num_frames=8)
    framing = FramingSampler((56, 112), aspect=(0.5, 1), crop="random", zoom=(1, 1.3), seed=2)
    ranks = [
        StepSampler(source, source.scenes, ViewSampler(2, 3, 6), 9, rank=rank, world_size=2, framing=framing)
        for rank in range(2)
    ]
    for step in range(20):
        drawn = [views.framing for sampler in ranks for views in sampler.step(step) if views.framing]
        assert len(drawn) == sum(len(sampler.step(step)) for sampler in ranks)
        assert {frame.size for frame in drawn} == {framing.size(step)}
        assert len({(frame.zoom, frame.place) for frame in drawn}) == len(drawn)
        assert all(1 <= frame.zoom <= 1.3 for frame in drawn)
    assert ranks[0].step(4) == ranks[0].step(4)


@pytest.mark.parametrize(
    "options",
    [
        {"fit": "squeeze"}, {"crop": "left"}, {"aspect": (2, 1)}, {"aspect": (0.5,)}, {"zoom": (0.5, 1)},
        {"fit": "pad", "crop": "random"}, {"fit": "pad", "zoom": (1, 1.2)}, {"size_multiple": 0},
        {"zoom": 1.5}, {"aspect": 1.0},
    ],
)  # fmt: skip
def test_impossible_framings_are_refused(options):
    with pytest.raises(ValueError, match=r"data\."):
        FramingSampler((28, 56), **options)


@pytest.mark.parametrize("size", [56, (56,), (28, 56, 3), "56", (28.5, 56), (0, 56)])
def test_a_size_is_height_and_width(size):
    with pytest.raises(ValueError, match=r"data\.image_size must be \[height, width\] in pixels, got"):
        SceneDataModule(SyntheticScenes(1), SyntheticScenes(1, first_seed=9), image_size=size)


def _module(rooms: SyntheticScenes, **options) -> SceneDataModule:
    return module_of(rooms, image_size=(14, 28), max_images=6, steps_per_epoch=6, **options)


DRAWN = {"aspect": [0.4, 1.2], "size_multiple": 2, "crop": "random", "zoom": [1, 1.4]}


def test_drawn_batches_are_the_same_with_any_workers_and_memory_and_evaluation_is_never_drawn(rooms):
    expected = list(_module(rooms, **DRAWN).train_dataloader())
    assert len({batch.images.shape[-2:] for batch in expected}) > 3
    assert len({batch.cameras.intrinsics[0, 0, 0, 0].item() for batch in expected}) == 6
    for options in ({"workers": 1}, {"workers": 2}, {"memory_mb": 0}):
        assert_same_batches(_module(rooms, **DRAWN, **options).train_dataloader(), expected)
    assert_same_batches(_module(rooms).val_dataloader(), _module(rooms, **DRAWN).val_dataloader())


def test_padded_batches_hold_whole_frames(rooms):
    batch = next(iter(_module(rooms, fit="pad").train_dataloader()))
    assert batch.images.shape[-2:] == (14, 28)
    assert not batch.depth[..., :, :4].any()
    assert not batch.depth[..., :, -4:].any()
    assert batch.depth[..., 8:20].all()
    assert not batch.mask[..., :4].any()
    assert (batch.mask[..., 8:20] == 1).all()
