"""What a step asks of a GPU, counted without one; and the one command for those who have one."""

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest
import torch

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


@pytest.fixture
def gpu(benchmark_script) -> ModuleType:
    return benchmark_script("gpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="only without a GPU")
def test_without_a_gpu_the_command_says_so(gpu: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="needs a GPU"):
        gpu.main(["--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())


def test_parts_are_collected_and_failures_told(gpu: ModuleType, tmp_path: Path) -> None:
    script = tmp_path / "part.py"
    script.write_text("import sys, pathlib; pathlib.Path(sys.argv[2], 'a.json').write_text('[3]'); print(sys.argv[3:])")
    good = gpu.measure(gpu.Part("good", (str(script), "--quick"), 60))
    assert good == {"ended": "done", "shown": "['--quick']\n", "results": [[3]]}
    bad = gpu.measure(gpu.Part("bad", ("-c", "raise ValueError('no such GPU')"), 60))
    assert bad["ended"].startswith("failed: ")
    assert bad["ended"].endswith("ValueError: no such GPU")
    late = gpu.measure(gpu.Part("late", ("-c", "import time; print('so far', flush=True); time.sleep(60)"), 2))
    assert late["ended"] == "stopped after 2 s"
    assert late["shown"] == "so far\n"
    text = gpu.markdown({"gpu": "X"}, {"good": good, "bad": bad})
    assert "## good: done" in text
    assert "no such GPU" in text


def test_every_part_names_a_script_that_is_there(gpu: ModuleType) -> None:
    for part in gpu.PARTS:
        assert part.command[0] == "-c" or Path(part.command[0]).is_file()
    assert sum(part.seconds for part in gpu.PARTS) <= 700
