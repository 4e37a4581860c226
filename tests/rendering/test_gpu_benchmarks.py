"""What a step asks of a GPU, counted without one; and the one command for those who have one."""

import importlib.util
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from vg2gt.io.files import read_json
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Cameras, Gaussians

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
if os.environ.get("TRITON_INTERPRET") == "1":
    pytest.skip("the interpreter's kernels are not launched as others are", allow_module_level=True)


@pytest.fixture
def step(benchmark_script) -> ModuleType:
    return benchmark_script("gpu_step")


def test_a_step_is_a_few_launches_and_one_wait_whatever_the_views(step: ModuleType) -> None:
    few, many = (step.count_step("triton", 400, views) for views in (1, 8))
    assert many.entries > few.entries > 400
    assert few.kernels == many.kernels == 6
    assert few.total == many.total <= 60
    assert few.waits == many.waits == 1
    assert many.megabytes > few.megabytes
    torch_ = step.count_step("torch", 100, 2)
    assert torch_.operations > 10 * many.total
    assert torch_.waits > 2


@pytest.mark.slow
def test_memory_of_eighteen_views(step: ModuleType) -> None:
    count = step.count_step("triton", 100_000, 18)
    assert count.entries > 1_000_000
    assert 100 < count.megabytes <= 600


@pytest.fixture
def estimate(benchmark_script) -> ModuleType:
    return benchmark_script("gpu_estimate")


def march(response: list[list[float]]) -> tuple[int, int]:
    """Entries that a tile's rays visit and meet, one after the other as a program goes."""
    before, met = [1.0] * len(response), 0
    for place in range(len(response[0])):
        if max(before) <= 0:
            return place, met
        hits = [ray for ray, row in enumerate(response) if before[ray] > 0 and row[place] >= 1 / 255]
        met += bool(hits)
        for ray in hits:
            after = before[ray] * (1 - response[ray][place])
            before[ray] = after if after >= 1e-4 else -before[ray]
    return len(response[0]), met


def test_visits_are_those_of_the_kernels(estimate: ModuleType) -> None:
    generator = torch.Generator().manual_seed(0)
    response = torch.rand(4, 30, generator=generator) * 0.98 * (torch.rand(4, 30, generator=generator) < 0.8)
    depths = torch.arange(30.0).expand(4, 30)
    count, blended, met, solved, solved_met = estimate._visits(response, depths, torch.full((4, 30), 1e4))
    assert (count, blended, met) == (30, *march(response.tolist()))
    assert 0 < blended < 30
    # narrow profiles: what lies behind the quarter of every ray does not matter to its median
    quarter = (torch.cumprod(1 - response, 1) <= 0.25).int().argmax(1)
    assert solved == int(quarter.max()) + 1
    assert solved_met == int((response[:, :solved] > 0).any(0).sum())
    kept = (response >= 1 / 255) & (torch.cumprod(1 - response, 1) >= 1e-4)
    wide = estimate._visits(response, depths, torch.full((4, 30), 1e-9))  # all that is kept matters
    assert solved < wide[3] == int(kept.any(0).nonzero().max()) + 1
    assert estimate._visits(response[:, :0], depths[:, :0], depths[:, :0]) == (0, 0, 0, 0, 0)


def test_instructions_of_loops_are_read_from_machine_code(estimate: ModuleType) -> None:
    def lines(count: int, what: str = "LDG.E R1, desc[UR4][R2.64]") -> list[str]:
        return [f"        /*0010*/                   {what} ;"] * count

    def jump(to: int) -> list[str]:
        return [f"        /*0010*/              @P0  BRA `(.L_x_{to}) ;"]

    outer = [
        ".L_x_0:",
        *lines(5),
        ".L_x_1:",
        *lines(10),
        *jump(2),
        *lines(60),
        ".L_x_2:",
        *lines(4),
        *jump(1),
        *jump(0),
    ]
    other = [".L_x_3:", *lines(50, "FADD R1, R1, R2"), *jump(3)]
    assert estimate.loops("\n".join([*outer, *other])) == [estimate.Loop(76, 16)]


def test_time_follows_visits(estimate: ModuleType) -> None:
    found = {name: estimate.Loop(300, 100) for name in ("blend", "section", "newton", "backward")}
    times = estimate.milliseconds(estimate.Visits(50, 20, 10, 8, 4), 1000, found)
    assert times["blend"] == times["backward"] == pytest.approx(1e6 * (10 * 300 + 10 * 100) / estimate.ISSUED)
    assert times["section"] == pytest.approx(4e6 * (4 * 300 + 4 * 100) / estimate.ISSUED)
    assert times["newton"] == pytest.approx(0.75 * times["section"])


STEP = ("step_ms", "peak_mb", "peak_reserved_mb", "stage_ms", "stage_peak_mb", "profile")


@pytest.fixture
def gpu(benchmark_script) -> ModuleType:
    return benchmark_script("gpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="only without a GPU")
def test_without_a_gpu_the_command_says_so(gpu: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="needs a GPU"):
        gpu.main(["--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("part", "found"),
    [
        ("render", {"cpu solid 500", "cpu rasterized 500"}),
        ("step", {f"tiny: {what}" for what in STEP}),
        ("knn", {"patch points", "pixels"}),
        ("reconstruct", {"2 images"}),
    ],
)
def test_every_part_measures_on_a_cpu_as_well(
    gpu: ModuleType, part: str, found: set[str], tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VG2GT_CACHE", str(cache))
    content = gpu.measure(part, gpu.Setting(torch.device("cpu"), small=True), tmp_path / "part.json")
    assert content["ended"] == "done"
    assert content["results"].keys() == found
    assert read_json(tmp_path / "part.json") == content
    if part == "step":
        stages = content["results"]["tiny: stage_ms"]
        assert {"encode", "coarse", "fine", "render", "loss", "backward", "optimizer"} <= stages.keys()
        assert all(taken > 0 for taken in stages.values())
        assert content["results"]["tiny: profile"]["launches"] > 1000


def test_what_a_part_found_before_it_failed_is_kept(
    gpu: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(setting: Any) -> Iterator[dict[str, Any]]:
        yield {"first": 1}
        raise RuntimeError("CUDA error:\nan illegal memory access")

    monkeypatch.setitem(gpu.PARTS, "knn", gpu.Part(fails, 9))
    content = gpu.measure("knn", gpu.Setting(torch.device("cpu"), small=True), tmp_path / "part.json")
    assert content["ended"] == "RuntimeError: CUDA error: an illegal memory access"
    assert content["results"] == {"first": 1}
    assert read_json(tmp_path / "part.json") == content


def test_parts_run_apart_and_within_their_time(
    gpu: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu.subprocess, "run", partial(only_seconds, gpu.subprocess.run, {"step": 0.01}))
    gpu.main(["--device", "cpu", "--small", "--out", str(tmp_path), "--parts", "knn", "step"])
    shown = capsys.readouterr().out
    assert "knn: done (" in shown
    assert "  patch points: ms " in shown
    assert "step: stopped after 150 s (" in shown
    assert [path.name.split("-", 3)[3] for path in tmp_path.iterdir()] == ["gpu-knn.json"]
    assert sum(part.seconds for part in gpu.PARTS.values()) <= 660  # all together end after --minutes


def only_seconds(run: Any, limits: dict[str, float], command: list[str], **options: Any) -> Any:
    """Runs a command with another limit, by the part that it measures."""
    return run(command, **{**options, "timeout": limits.get(command[3], options["timeout"])})


def test_many_refused_slots_do_not_overflow_their_sum(benchmark_script) -> None:
    """One bad camera seen by ten million Gaussians: with 2^40 a slot the sum was negative, and memory was asked for."""
    from vg2gt.kernels.render_gpu.projection import REFUSED, SLOTS
    from vg2gt.rendering.gpu_tiles import RefusedError, render_triton

    assert SLOTS * REFUSED < 1 << 63
    count = (1 << 23) + 5
    one, matrix = torch.zeros(1, 3).expand(count, 3), torch.eye(4).expand(1, 1, 4, 4)
    gaussians = Gaussians(one, torch.ones(1, 4).expand(count, 4), one, one[:, 0], one[:, None], one[:, 0].long())
    cameras = Cameras(matrix, matrix[..., :3, :3], (8, 8))
    refused = benchmark_script("gpu_kernels").recorded({"project_kernel": lambda counts, **_: counts.fill_(REFUSED)})
    with refused, pytest.raises(RefusedError, match="cannot be rendered"):
        render_triton(gaussians, cameras, torch.zeros(3), RenderOptions())


def test_more_slots_than_can_be_numbered_are_refused(benchmark_script) -> None:
    """A view whose Gaussians are so many; views are rendered in parts."""
    from vg2gt.rendering.gpu_tiles import _list

    views, count = (1 << 19) + 1, 1 << 11
    few, matrix = torch.zeros(count, 3), torch.eye(4).expand(1, views, 4, 4)
    tensors = (few, torch.ones(count, 4), few, few[:, 0], few[:, None], matrix, matrix[..., :3, :3], few[0])
    with benchmark_script("gpu_kernels").recorded(), pytest.raises(ValueError, match="2048 Gaussians in 524289 views"):
        _list((*tensors, few[:, 0].long()), (8, 8), RenderOptions(), 1)
