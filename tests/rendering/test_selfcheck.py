"""The kernels are checked on the device before they are relied on: right ones pass, wrong ones are refused."""

import importlib.util
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

from vg2gt.rendering import renderer, selfcheck
from vg2gt.rendering.options import Mode
from vg2gt.rendering.selfcheck import GRADIENTS, VALUES, Agreement, KernelsRefusedError

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
interpreted = pytest.mark.skipif(not INTERPRETED, reason="runs in the process that test_triton.py starts")
GPU = torch.device("cuda")

# Kernels made wrong: the file, what is replaced in it, and by what. A Gaussian's gradient is the sum of one row a tile;
# to keep one of them only is what additions without atomics would do.
MUTANTS = {
    "sign flipped": ("tiles", "ge = -0.5 * ga * inverse", "ge = 0.5 * ga * inverse"),
    "off by one tile": ("tiles", "x = (tile % across) * _TILE", "x = (tile % across + 1) * _TILE"),
    "rows not summed": (
        "projection_backward",
        "most = tl.max(count, 0)",
        "count = tl.minimum(count, 1); most = tl.max(count, 0)",
    ),
}


@interpreted
@pytest.mark.parametrize("mode", ["rasterized", pytest.param("solid", marks=pytest.mark.slow)])
def test_right_kernels_agree_far_within_the_bounds(mode: Mode) -> None:
    found = selfcheck.compare(torch.device("cpu"), (mode,))
    assert found.good
    assert found.values < VALUES / 10
    assert found.gradients < GRADIENTS / 10


@interpreted
@pytest.mark.parametrize(
    "name", [name if name == "rows not summed" else pytest.param(name, marks=pytest.mark.slow) for name in MUTANTS]
)
def test_wrong_kernels_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vg2gt.kernels.render_gpu import kernels

    module, before, after = MUTANTS[name]
    source = Path(kernels.__file__).with_name(f"{module}.py").read_text()
    assert source.count(before) == 1
    path = tmp_path / "wrong_kernels.py"
    path.write_text(source.replace(before, after))
    spec = importlib.util.spec_from_file_location("wrong_kernels", path)
    wrong = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(wrong)
    for kernel in kernels.__all__:
        if hasattr(wrong, kernel):
            monkeypatch.setattr(kernels, kernel, getattr(wrong, kernel))
    found = selfcheck.compare(torch.device("cpu"), ("rasterized",))
    assert not found.good
    # Far outside the bounds, or not a number: a tile that is left out keeps whatever was in memory.
    assert not max(found.values / VALUES, found.gradients / GRADIENTS) <= 10


class Validating(lightning.LightningModule):
    """Acts once in the validation step of an evaluation."""

    def __init__(self, act: Callable[[], None]) -> None:
        super().__init__()
        self.act = act

    def validation_step(self, batch: Any, index: int) -> None:
        assert torch.is_inference_mode_enabled()
        self.act()


def validating(act: Callable[[], None]) -> None:
    options: Any = {"accelerator": "cpu", "logger": False, "enable_progress_bar": False, "precision": "bf16-mixed"}
    trainer = lightning.Trainer(**options, enable_checkpointing=False)
    trainer.validate(Validating(act), DataLoader(TensorDataset(torch.zeros(1))), verbose=False)


@interpreted
@pytest.mark.parametrize(
    "surrounded",
    [torch.no_grad(), pytest.param(torch.inference_mode(), marks=pytest.mark.slow), validating],
    ids=["no_grad", "inference_mode", "validation step"],
)
def test_the_check_does_not_depend_on_what_surrounds_the_first_render(surrounded, tmp_path, monkeypatch):
    """The real check, of one mode; its error was taken for a disagreement wherever gradients were off."""
    monkeypatch.setattr(selfcheck, "compare", partial(selfcheck.compare, modes=("rasterized",)))
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: tmp_path)
    selfcheck._refusal.cache_clear()
    act = partial(selfcheck.require_trusted, torch.device("cpu"))
    if surrounded is validating:
        validating(act)
    else:
        surrounded(act)()
    assert (tmp_path / "gpu_agreement.json").is_file()


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Devices that were checked, on a machine that pretends to have some; what is found is kept in ``tmp_path``."""
    asked: list[str] = []

    def compare(device: torch.device) -> Agreement:
        asked.append(str(device))
        return Agreement(1e-6, 1e-6)

    monkeypatch.setattr(selfcheck, "compare", compare)
    monkeypatch.setattr(selfcheck, "identity", lambda device: f"device {device}, triton 3")
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    selfcheck._refusal.cache_clear()
    return asked


def test_agreement_makes_auto_triton_and_is_found_out_once(checks: list[str]) -> None:
    assert renderer.automatic(torch.device("cpu")) == "cpu"
    assert renderer.automatic(GPU) == renderer.automatic(GPU) == "triton"
    selfcheck._refusal.cache_clear()  # as in another process
    assert (renderer.automatic(GPU), checks) == ("triton", ["cuda"])
    assert renderer.automatic(torch.device("cuda", 1)) == "triton"  # another device is another matter
    assert checks == ["cuda", "cuda:1"]


@pytest.mark.parametrize(
    "found",
    [
        Agreement(2 * VALUES, 0.0),
        Agreement(0.0, 2 * GRADIENTS),
        Agreement(float("nan"), 0.0),
        Agreement(0.0, float("nan")),
    ],
)
def test_disagreement_is_an_error_that_says_what_to_report_and_what_to_choose(checks, found, monkeypatch):
    monkeypatch.setattr(selfcheck, "compare", lambda *_: found)
    for again in (False, True):  # the next process knows it, too
        with pytest.raises(KernelsRefusedError, match="disagree with the reference: max image error") as error:
            renderer.automatic(GPU)
        assert "Please report this line: device cuda, triton 3. To render without these kernels" in str(error.value)
        if not again:
            selfcheck._refusal.cache_clear()


def test_kernels_that_do_not_run_are_an_error_and_are_tried_again_by_the_next_process(checks, monkeypatch):
    tries = []

    def broken(*_: Any) -> Agreement:
        tries.append(1)
        raise RuntimeError("no C compiler\nwas found")

    with monkeypatch.context() as patched:
        patched.setattr(selfcheck, "compare", broken)
        for _ in range(2):
            with pytest.raises(KernelsRefusedError, match=r"do not run \(RuntimeError: no C compiler was found\)"):
                renderer.automatic(GPU)
    assert len(tries) == 1
    selfcheck._refusal.cache_clear()
    assert renderer.automatic(GPU) == "triton"


def test_a_gpu_without_triton_is_told_so(checks: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(KernelsRefusedError, match=r"triton.* is not installed\. .*renderer\.implementation=cpu"):
        renderer.automatic(GPU)
    assert renderer._resolve("cpu", GPU) == "cpu"


def test_what_was_found_holds_for_these_kernels_alone() -> None:
    """The kernels' sources are part of what an agreement is kept for."""
    names = {path.name for path in selfcheck.SOURCES if path.is_file()}
    assert {"tiles.py", "projection.py", "binning.py", "harmonics.py", "gpu_tiles.py"} <= names
