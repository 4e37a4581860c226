"""Training keeps nothing of its steps: as many live tensors after a step as eight steps before."""

import gc
from pathlib import Path
from typing import Any

import lightning
import torch

from tests.training_helpers import small_config
from vg2gt.training.loop import build


def live_tensors() -> tuple[int, int]:
    """How many tensors with memory there are, and their bytes; exports leave fake ones of no size behind."""
    gc.collect()
    found = [each for each in gc.get_objects() if type(each) in (torch.Tensor, torch.nn.Parameter)]
    return len(found), sum(each.numel() * each.element_size() for each in found)


class CountTensors(lightning.Callback):
    """Counts at the end of some steps."""

    def __init__(self, steps: tuple[int, ...]) -> None:
        self.found: dict[int, tuple[int, int]] = dict.fromkeys(steps, (0, 0))

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        if trainer.global_step in self.found:
            self.found[trainer.global_step] = live_tensors()


def test_steps_leave_no_tensors_behind(tmp_path: Path, cache: Path) -> None:
    counts = CountTensors((6, 14))
    size = ["data.image_size=[28,56]", "data.min_views=3", "data.max_views=3", "data.max_images=3"]
    run = build(small_config(tmp_path, cache, *size, "trainer.max_steps=14"))
    run.trainer.callbacks.append(counts)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit(run.module, datamodule=run.datamodule)
    (before, bytes_before), (after, bytes_after) = counts.found.values()
    assert before > 500  # weights and moments, for one
    assert after == before
    assert abs(bytes_after - bytes_before) < 0.1 * bytes_before  # batches differ in their Gaussians
