"""The kernels are checked on the device before they are relied on: right ones pass, wrong ones are refused."""

import importlib.util
import os
from pathlib import Path
from typing import Any

import pytest
import torch

from vg2gt.rendering import renderer, selfcheck
from vg2gt.rendering.options import Mode
from vg2gt.rendering.selfcheck import GRADIENTS, VALUES, Agreement, KernelsRefusedError

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
interpreted = pytest.mark.skipif(not INTERPRETED, reason="runs in the process that test_triton.py starts")
GPU = torch.device("cuda")


@interpreted
@pytest.mark.parametrize("mode", ["rasterized", pytest.param("solid", marks=pytest.mark.slow)])
def test_right_kernels_agree_far_within_the_bounds(mode: Mode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever surrounds the first render, as in an evaluation in mixed precision."""
    agreed: list[Agreement] = []

    def compare(device: torch.device) -> Agreement:
        agreed.append(real(device, (mode,)))
        return agreed[0]

    real = selfcheck.compare
    monkeypatch.setattr(selfcheck, "compare", compare)
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: tmp_path)
    selfcheck._refusal.cache_clear()
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        selfcheck.require_trusted(torch.device("cpu"))
    assert (tmp_path / "gpu_agreement.json").is_file()
    (found,) = agreed
    assert found.good
    assert found.values < VALUES / 10
    assert found.gradients < GRADIENTS / 10


@interpreted
def test_wrong_kernels_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Gaussian's gradient is the sum of one row a tile; additions without atomics would keep one of them."""
    from vg2gt.rendering.gpu import kernels

    source = Path(kernels.__file__).with_name("projection_backward.py").read_text()
    right = "most = tl.max(count, 0)"
    assert source.count(right) == 1
    path = tmp_path / "wrong_kernels.py"
    path.write_text(source.replace(right, f"count = tl.minimum(count, 1); {right}"))
    spec = importlib.util.spec_from_file_location("wrong_kernels", path)
    wrong = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(wrong)
    monkeypatch.setattr(kernels, "project_backward_kernel", wrong.project_backward_kernel)
    monkeypatch.setattr(selfcheck, "SIZE", (5, 11))  # two tiles instead of four
    found = selfcheck.compare(torch.device("cpu"), ("rasterized",))
    assert not found.good
    assert found.gradients / GRADIENTS > 10


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


@pytest.mark.parametrize("found", [Agreement(2 * VALUES, 0.0), Agreement(0.0, float("nan"))])
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
