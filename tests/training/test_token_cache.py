"""With a token cache a frozen backbone runs once for a set of views."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.training_helpers import small_config
from vg2gt.training.loop import Run, build
from vg2gt.types import Batch

STEPS, SCENES = 4, 2


def losses_and_runs(run: Run, context: int | None) -> tuple[list[float], list[int]]:
    """Losses of the first steps, no weight changed between them, and how many views each sent through the backbone."""
    run.datamodule.setup("fit")
    module, backend = run.module.train(), run.module.model.backend
    encode, views = backend.encode, []

    def counted(images, hints=None):
        views[-1] += images.shape[1]
        return encode(images, hints)

    losses = []
    backend.encode = counted
    batches = iter(run.datamodule.train_dataloader())
    for _ in range(STEPS):
        batch: Batch = next(batches)
        views.append(0)
        module.generator.manual_seed(0)
        loss = module.training_step(replace(batch, num_context=context or batch.num_context), 0)
        losses.append(float(loss.detach()))
    return losses, views


@pytest.mark.parametrize("context", [None, 1])  # a single view's joint pass needs depth as well as cameras
def test_the_backbone_runs_once_for_a_set_of_views(tmp_path: Path, context: int | None) -> None:
    overrides = ("backend=da3_tiny", f"data.train_scenes={SCENES}", "data.view_sets=1", "data.target_views=1")
    kept = ("token_cache.max_gb=1", f"token_cache.folder={tmp_path / 'tokens'}")
    runs = [build(small_config(tmp_path, tmp_path / "rooms", *overrides, *more)) for more in ((), kept)]
    torch.manual_seed(0)
    (plain, every), (cached, once) = (losses_and_runs(run, context) for run in runs)
    assert min(every) > 0
    assert (once[:SCENES], once[SCENES:]) == (every[:SCENES], [0] * (STEPS - SCENES))
    assert (cached, sorted(cached[:SCENES])) == (plain, sorted(cached[SCENES:]))
