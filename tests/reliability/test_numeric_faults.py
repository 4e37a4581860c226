"""NaN and infinity in data, backbone, losses and gradients: the step is dropped everywhere, counted and named."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.reliability.crash_harness import assert_equal
from tests.reliability.steps import TINY, Poison, first_batches, fit, named, tiny_run
from tests.training_helpers import small_config, with_crash
from vg2gt.runs.checkpoints import newest, read_checkpoint
from vg2gt.training.loop import Run, train
from vg2gt.types import Batch

VALUES = (float("nan"), float("inf"), -float("inf"))


@pytest.fixture
def run(tmp_path: Path, cache: Path) -> Run:
    return tiny_run(tmp_path, cache)


def spoiled(batch: Batch, part: str, value: float) -> Batch:
    """A copy with one bad value in the last view."""
    batch = batch.map(Tensor.clone)
    tensors = {"images": batch.images, "depth": batch.depth}
    tensors |= {"world_to_camera": batch.cameras.world_to_camera, "intrinsics": batch.cameras.intrinsics}
    tensors[part][-1, -1].view(-1)[0] = value
    return batch


PARTS = [(part, value) for part in ("images", "depth", "world_to_camera", "intrinsics") for value in VALUES]
PARTS += [("intrinsics", 0.0), ("intrinsics", -40.0)]


def test_a_bad_value_in_the_data_drops_the_step(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    (good,) = first_batches(run, 1)
    bad = [named(spoiled(good, part, value), f"room-{i}") for i, (part, value) in enumerate(PARTS)]
    audit = fit(run, [good, *bad, good])
    audit.assert_sound()
    assert audit.skipped == [False, *([True] * len(bad)), False]
    for i in range(len(PARTS)):
        assert f"non-finite values: step {i + 1}, rank 0, room-{i}: images, depth or cameras" in caplog.text
    assert run.module.skipped.faults[0] == "step 1, rank 0, room-0: images, depth or cameras of the batch"


Change = Callable[[Any], Any]


def _pixels(part: str, value: float, everywhere: bool) -> Change:
    def change(geometry: Any) -> Any:
        pixels = getattr(geometry, part).clone()
        (pixels if everywhere else pixels[..., 3, 5])[...] = value
        return replace(geometry, **{part: pixels})

    return change


def _cameras(part: str, value: float) -> Change:
    def change(geometry: Any) -> Any:
        tensor = getattr(geometry.cameras, part).clone()
        tensor[:, -1, 0, 0] = value
        return replace(geometry, cameras=replace(geometry.cameras, **{part: tensor}))

    return change


def _tokens(part: str, value: float) -> Change:
    def change(tokens: Any) -> Any:
        if part == "camera":
            return replace(tokens, camera=torch.full_like(tokens.camera, value))
        patch = tuple(tap.clone() for tap in tokens.patch)
        patch[-1 if part == "last" else 0][:, 0, 1] = value
        return tokens.with_patch(patch)

    return change


# what is changed, how, whether the step must be dropped (None: either way)
BACKBONE: list[tuple[str, Change, bool | None]] = []
for part in ("depth", "depth_conf"):
    BACKBONE += [("decode", _pixels(part, value, all_), None) for value in VALUES for all_ in (False, True)]
BACKBONE += [("decode", _cameras(part, value), True) for part in ("world_to_camera", "intrinsics") for value in VALUES]
BACKBONE += [("encode", _tokens(part, value), True) for part in ("first", "last") for value in VALUES]
BACKBONE += [("encode", _tokens("camera", value), None) for value in VALUES]


def test_a_bad_value_from_the_backbone_does_no_harm(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels without a finite depth or confidence are pixels without depth; bad tokens and cameras drop the step."""
    backend = run.module.model.backend

    def spoil(name: str, original: Callable[..., Any], *args: Any) -> Any:
        result, step = original(*args), run.trainer.global_step
        where, change, _ = BACKBONE[step] if step < len(BACKBONE) else ("", None, None)
        return change(result) if where == name and change else result

    for name in ("encode", "decode"):
        monkeypatch.setattr(backend, name, partial(spoil, name, getattr(backend, name)))
    (good,) = first_batches(run, 1)
    audit = fit(run, [good] * (len(BACKBONE) + 1))
    audit.assert_sound()
    assert not audit.skipped[-1]
    for (_, _, expected), skipped in zip(BACKBONE, audit.skipped[:-1], strict=True):
        assert expected is None or skipped is expected


def test_a_bad_gradient_of_one_parameter_skips_the_step(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    """That of the n-th parameter in the n-th step."""

    def spoil(step: int, gradient: Tensor) -> Tensor:
        if run.trainer.global_step == step:
            gradient = gradient.clone(memory_format=torch.contiguous_format)
            gradient.view(-1)[-1] = VALUES[step % len(VALUES)]
        return gradient

    parameters = [parameter for parameter in run.module.model.parameters() if parameter.requires_grad][::20]
    for step, parameter in enumerate(parameters):
        parameter.register_hook(partial(spoil, step))
    (good,) = first_batches(run, 1)
    audit = fit(run, [good] * (len(parameters) + 1))
    audit.assert_sound()
    assert audit.skipped == [True] * len(parameters) + [False]
    assert f"non-finite values: step 1, rank 0, {good.scene[0]}: gradient" in caplog.text


def test_too_many_in_a_row_stop_the_run_with_their_causes(tmp_path: Path, cache: Path) -> None:
    run = tiny_run(tmp_path, cache, "++training.max_skipped=3")
    (good,) = first_batches(run, 1)
    bad = [named(spoiled(good, "depth", float("nan")), f"room-{i}") for i in range(5)]
    expected = r"3 steps in a row .* rank 0, room-4: images, depth or cameras of the batch\. .*training\.max_skipped"
    with pytest.raises(FloatingPointError, match=expected):
        fit(run, [bad[0], bad[1], good, bad[2], bad[3], bad[4]])
    assert run.module.skipped.total == 5
    with pytest.raises(ValueError, match=r"training\.max_skipped must be at least 1"):
        tiny_run(tmp_path, cache, "++training.max_skipped=0")


def test_a_dropped_step_counts_for_schedule_and_data(tmp_path: Path, cache: Path) -> None:
    """Learning rate, random draws and optimiser go on as if only the weights had not been told."""
    run = tiny_run(tmp_path / "a", cache)
    one, two, three = first_batches(run, 3)
    disturbed = fit(run, [one, spoiled(two, "images", float("nan")), three])
    assert run.trainer.global_step == 3
    undisturbed = fit(tiny_run(tmp_path / "b", cache), [one, two, three])
    assert (disturbed.rates, len(set(disturbed.rates))) == (undisturbed.rates, 3)
    steps = {int(state["step"]) for state in run.trainer.optimizers[0].state.values()}
    assert steps == {2}


RESUMABLE = [override for override in TINY if not override.startswith(("callbacks.", "logger"))]
RESUMABLE += [f"+callbacks.poison._target_={Poison.__module__}.Poison", "+callbacks.poison.steps=[1,2]"]


def test_resume_across_dropped_steps_equals_the_uninterrupted_run(tmp_path: Path, cache: Path) -> None:
    """Checkpoints fall between two dropped steps: the second one is the first of the resumed run."""
    whole = train(small_config(tmp_path / "whole", cache, *RESUMABLE))
    with pytest.raises(InterruptedError):
        train(with_crash(small_config(tmp_path / "cut", cache, *RESUMABLE), step=3))
    resumed = train(small_config(tmp_path / "cut", cache, *RESUMABLE, "ckpt=last"))
    assert (resumed, whole["skipped_steps"]["total"]) == (whole, 2)
    assert [fault[:6] for fault in whole["skipped_steps"]["faults"]] == ["step 1", "step 2"]
    assert json.loads((tmp_path / "cut" / "metrics.json").read_text()) == resumed
    first, second = (read_checkpoint(newest(tmp_path / name / "checkpoints")) for name in ("whole", "cut"))
    for name in ("skipped_steps", "state_dict", "optimizer_states"):
        assert_equal(first[name], second[name], name)
    counts = [row.split(",") for row in next((tmp_path / "whole").glob("logs/*/metrics.csv")).read_text().splitlines()]
    column = counts[0].index("train/skipped_steps")
    assert [row[column] for row in counts[1:] if row[column]] == ["0.0", "1.0", "2.0", "2.0"]
