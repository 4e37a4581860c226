"""What a training step of the paper's model asks of a GPU, counted on the CPU."""

from pathlib import Path

import torch

# At fe8e252, counted alike: 20,262 and a render of 8 views in plain torch, which every fresh run took there.
BEFORE = 20_262 + 10_113
WAITS = 40


def test_operations_and_waits_of_a_training_step(benchmark_script, tmp_path: Path) -> None:
    stages = benchmark_script("stages")
    tiny = ("backend=da3_tiny", "backend.pretrained=false", "trainer.precision=bf16-mixed")
    case = stages.Case(2, (28, 56), ("experiment=paper", "data=synthetic", *tiny))
    run, batch = stages.prepare(case, torch.device("cpu"), str(tmp_path))
    operations, waits = benchmark_script("gpu_waits").count_step(run, batch.context)
    assert 0 < waits.total() <= WAITS, waits.most_common()
    assert 5_000 < operations.total() <= 8_500 < BEFORE / 3, operations.most_common(30)
