"""What a step asks of a GPU, counted without one; and the one command for those who have one."""

import importlib
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

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu_step")


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
def gpu(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu")


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
