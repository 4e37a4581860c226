"""Batches for training and evaluation, and the same batches after a resume."""

from functools import partial
from types import SimpleNamespace

import lightning
import pytest
import torch

from vg2gt.data import DataError, SceneDataModule, SyntheticScenes
from vg2gt.data.batches import FrameCache
from vg2gt.data.transforms import resize_to_cover
from vg2gt.data.views.even import EvaluationViews

from .conftest import SIZE, module_of


def test_training_batches(rooms):
    module = module_of(rooms, target_views=1)
    batches = list(module.train_dataloader())
    assert len(batches) == 4
    for batch in batches:
        scenes, views = batch.frame_ids.shape
        assert scenes == len(batch.scene) == 4 // batch.num_context
        assert (views, batch.images.shape) == (batch.num_context + 1, (scenes, views, 3, *SIZE))
        assert (batch.depth.shape, batch.cameras.size) == ((scenes, views, *SIZE), SIZE)
        direct = rooms.load(batch.scene[0], batch.frame_ids[0].tolist())
        torch.testing.assert_close(batch.images[0], direct.images, atol=1e-6, rtol=0)
        assert torch.equal(batch.depth[0], direct.depth)
        assert torch.equal(batch.cameras.world_to_camera[0], direct.world_to_camera)
        assert torch.equal(batch.cameras.intrinsics[0], direct.intrinsics)


def test_evaluation_batches_are_context_then_targets(rooms):
    batches = list(module_of(rooms).val_dataloader())
    assert [batch.scene for batch in batches] == [("room-000100",), ("room-000101",)]
    assert (batches[0].frame_ids.tolist(), batches[0].num_context) == ([[0, 2, 4, 1, 3]], 3)
    assert batches[0].target.frame_ids.tolist() == [[1, 3]]


def test_the_limit_of_evaluated_windows_is_that_of_all_devices_together(rooms):
    long = SyntheticScenes(3, first_seed=100, num_frames=200, size=SIZE)
    options = {"val": long, "eval_context": 1, "eval_target": 1, "eval_window": 2}

    def evaluated(devices: int, **more) -> list:
        module = module_of(rooms, **options, **more)
        found = []
        for rank in range(devices):
            strategy = SimpleNamespace(root_device=torch.device("cpu"))
            module.trainer = SimpleNamespace(global_rank=rank, world_size=devices, strategy=strategy)  # pyright: ignore[reportAttributeAccessIssue]
            found += [(views.scene, *views.context) for (views,) in module.val_dataloader().sampler]
        return sorted(found)

    whole, one = evaluated(1), evaluated(1, eval_samples=40)
    assert len(whole) == len(set(whole)) == 300
    assert (len(one), one[0], one[-1]) == (40, whole[0], whole[-1])
    assert {scene for scene, _ in one} == set(long.scenes)
    assert evaluated(2, eval_samples=40) == evaluated(8, eval_samples=40) == one


def test_training_and_evaluation_on_the_same_scenes_is_refused(rooms):
    same = SyntheticScenes(2, num_frames=6, size=SIZE, first_seed=3)
    with pytest.raises(DataError, match="room-000003 is used for training and for evaluation"):
        module_of(rooms, val=same).setup()


class _Recorder(lightning.LightningModule):
    """Learns a sum that depends on every batch and its order."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[tuple[str, ...]] = []

    def training_step(self, batch, batch_idx):
        self.seen.append((*batch.scene, *map(str, batch.frame_ids.flatten().tolist())))
        return (self.weight - batch.images.mean()) ** 2

    def validation_step(self, batch, batch_idx):
        self.log("targets", float(batch.frame_ids.shape[1] - batch.num_context), batch_size=1)

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("stop", "workers"), [(4, 2), (6, 1)])
def test_a_resumed_run_sees_the_batches_of_the_uninterrupted_one(rooms, tmp_path, stop, workers):
    """Stops at the end of an epoch and within the next one (4 steps each); workers read ahead of the stop."""

    def run(steps: int, workers: int, **resume) -> _Recorder:
        recorder = _Recorder()
        trainer = lightning.Trainer(
            max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False, use_distributed_sampler=False,
        )  # fmt: skip
        trainer.fit(recorder, datamodule=module_of(rooms, workers=workers), **resume)
        trainer.save_checkpoint(tmp_path / f"{steps}.ckpt")
        return recorder

    whole, first = run(10, 0), run(stop, workers)
    second = run(10, workers, ckpt_path=tmp_path / f"{stop}.ckpt")
    assert first.seen + second.seen == whole.seen
    assert torch.equal(second.weight, whole.weight)


def test_the_memory_cache_forgets_the_oldest_frame(rooms, monkeypatch):
    loads = []
    load = rooms.load
    monkeypatch.setattr(rooms, "load", lambda scene, ids: loads.append(list(ids)) or load(scene, ids))
    frame_bytes = SIZE[0] * SIZE[1] * 7 + 25 * 4
    cache = FrameCache(rooms, partial(resize_to_cover, size=SIZE), 3 * frame_bytes)
    first = cache.load("room-000000", [0, 1, 2])
    cache.load("room-000000", [0, 1])
    cache.load("room-000000", [3])  # drops frame 2
    again = cache.load("room-000000", [1, 2])
    assert loads == [[0, 1, 2], [3], [2]]
    assert torch.equal(again.depth, first.depth[[1, 2]])


def test_evaluation_views_by_number_and_window_and_positions_are_checked(rooms):
    source = SyntheticScenes(1, num_frames=20)
    source.held_out = lambda scene: range(3, 20, 6)
    (views,) = EvaluationViews(context=4, target=2).choose(source, "room-000000")
    assert (views.context, views.target) == ((0, 6, 13, 19), (3, 15))
    windows = EvaluationViews(context=3, target=9, window=10).choose(source, "room-000000")
    assert [window.target for window in windows] == [(3, 9), (15,)]
    assert windows[1].context[0] == 10
    for window in windows:
        assert not set(window.context) & set(window.target)
    with pytest.raises(DataError, match=r"eval_target names positions \[6\], but scene room-000000 has 6 frames"):
        EvaluationViews([0, 1], [2, 6]).choose(rooms, "room-000000")
    with pytest.raises(DataError, match="both context and target"):
        EvaluationViews([0, 1], [1]).choose(rooms, "room-000000")
    with pytest.raises(ValueError, match="numbers of views"):
        EvaluationViews([0, 1], [1], window=4)


def test_data_that_cannot_be_trained_on_is_named_before_overlap_and_lengths(rooms, tmp_path):
    blind = SyntheticScenes(2, num_frames=1, size=SIZE, cache_dir=str(tmp_path))
    blind.has_cameras = False
    module = module_of(rooms, train=blind, val=blind, eval_context=1, eval_target=0)
    with pytest.raises(DataError, match="has no cameras"):
        module.setup()


def test_an_option_of_another_loader_is_named():
    module = SceneDataModule(partial(SyntheticScenes, 1), partial(SyntheticScenes, 1), every=2)
    with pytest.raises(DataError, match=r"\(data\.\*\): .*unexpected keyword argument 'every'; remove the option"):
        module.evaluation_data()
