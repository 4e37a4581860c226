"""The kernels are checked on the device before they are relied on: right ones pass, wrong ones are refused."""

import importlib.util
import logging
import os
from pathlib import Path
from typing import Any

import pytest
import torch

from vg2gt.rendering import render, renderer, selfcheck
from vg2gt.rendering.options import Mode
from vg2gt.rendering.selfcheck import GRADIENTS, VALUES, Agreement

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
    found = selfcheck.compare(render, torch.device("cpu"), (mode,))
    assert found.good
    assert found.values < VALUES / 10
    assert found.gradients < GRADIENTS / 10


@interpreted
@pytest.mark.parametrize(
    "name", [name if name == "rows not summed" else pytest.param(name, marks=pytest.mark.slow) for name in MUTANTS]
)
def test_wrong_kernels_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vg2gt.rendering.gpu import kernels

    module, before, after = MUTANTS[name]
    source = (selfcheck.KERNELS / f"{module}.py").read_text()
    assert source.count(before) == 1
    path = tmp_path / "wrong_kernels.py"
    path.write_text(source.replace(before, after))
    spec = importlib.util.spec_from_file_location("wrong_kernels", path)
    assert spec is not None
    assert spec.loader is not None
    wrong = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(wrong)
    for kernel in kernels.__all__:
        if hasattr(wrong, kernel):
            monkeypatch.setattr(kernels, kernel, getattr(wrong, kernel))
    found = selfcheck.compare(render, torch.device("cpu"), ("rasterized",))
    assert not found.good
    # Far outside the bounds, or not a number: a tile that is left out keeps whatever was in memory.
    assert not max(found.values / VALUES, found.gradients / GRADIENTS) <= 10


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Devices that were checked, on a machine that pretends to have some; what is found is kept in ``tmp_path``."""
    asked: list[str] = []

    def compare(_: Any, device: torch.device) -> Agreement:
        asked.append(str(device))
        return Agreement(1e-6, 1e-6)

    monkeypatch.setattr(selfcheck, "compare", compare)
    monkeypatch.setattr(selfcheck, "identity", lambda device: f"device {device}, triton 3")
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    selfcheck._trusted.cache_clear()
    return asked


def test_agreement_makes_auto_triton_and_is_found_out_once(checks: list[str]) -> None:
    assert renderer.automatic(torch.device("cpu")) == "cpu"
    assert renderer.automatic(GPU) == renderer.automatic(GPU) == "triton"
    selfcheck._trusted.cache_clear()  # as in another process
    assert renderer.automatic(GPU) == "triton"
    assert checks == ["cuda"]
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
def test_disagreement_falls_back_with_one_line(
    checks: list[str], found: Agreement, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(selfcheck, "compare", lambda *_: found)
    with caplog.at_level(logging.WARNING):
        assert renderer.automatic(GPU) == renderer.automatic(GPU) == "torch"
    (record,) = caplog.records
    assert "disagree with the reference: values off by" in record.getMessage()
    assert record.getMessage().endswith("Please report this line: device cuda, triton 3")
    selfcheck._trusted.cache_clear()
    assert renderer.automatic(GPU) == "torch"


def test_kernels_that_do_not_run_fall_back_and_are_tried_again_by_the_next_process(
    checks: list[str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any) -> Agreement:
        raise RuntimeError("no C compiler\nwas found")

    with monkeypatch.context() as patched:
        patched.setattr(selfcheck, "compare", broken)
        assert renderer.automatic(GPU) == renderer.automatic(GPU) == "torch"
    (record,) = caplog.records
    assert "do not run (RuntimeError: no C compiler was found)" in record.getMessage()
    selfcheck._trusted.cache_clear()
    assert renderer.automatic(GPU) == "triton"


def test_without_a_folder_to_keep_it_in_every_process_checks(
    checks: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selfcheck, "cache_folder", lambda: None)
    assert renderer.automatic(GPU) == "triton"
    selfcheck._trusted.cache_clear()
    assert renderer.automatic(GPU) == "triton"
    assert checks == ["cuda", "cuda"]


def test_the_identity_names_versions_and_the_kernels() -> None:
    found = selfcheck.identity(torch.device("cpu"))
    assert f"torch {torch.__version__}" in found
    assert "kernels " in found


def test_the_fixed_scene_does_not_depend_on_random_generators() -> None:
    torch.manual_seed(0)
    first = selfcheck.fixed_scene()
    torch.manual_seed(1)
    assert all(torch.equal(a, b) for a, b in zip(first, selfcheck.fixed_scene(), strict=True))
    assert 0.05 < float(first[3].min()) < float(first[3].max()) == 1.0
