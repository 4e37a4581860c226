"""What a training step of the paper's model asks of a GPU, counted on the CPU."""

from pathlib import Path
from types import ModuleType

import torch

TODAY = 0  # operations at fe8e252, counted alike


def test_operations_and_waits_of_a_training_step(benchmark_script, tmp_path: Path) -> None:
    stages: ModuleType = benchmark_script("stages")
    tiny = ("backend=da3_tiny", "backend.pretrained=false", "trainer.precision=bf16-mixed")
    case = stages.Case(2, (28, 56), ("experiment=paper", "data=synthetic", *tiny))
    run, batch = stages.prepare(case, torch.device("cpu"), str(tmp_path))
    operations, waits = benchmark_script("gpu_waits").count_step(run, batch.context)
    assert waits.total() <= 40, waits.most_common()
    assert operations.total() <= TODAY / 3, operations.most_common(30)
