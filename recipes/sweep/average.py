"""Averages weights: ``python -m recipes.sweep.average OUT FILE FILE...``.

Weights that continue one training in different ways are often worse than their mean ("Model soups", ICML 2022).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from vg2gt.io.files import write_bytes


def average(files: list[Path]) -> dict[str, Tensor]:
    """Returns the mean of the tensors of files that hold the same network."""
    states = [load_file(file) for file in files]
    shapes = [{name: tensor.shape for name, tensor in state.items()} for state in states]
    for file, other in zip(files, shapes, strict=True):
        if other != shapes[0]:
            raise ValueError(f"{file} does not hold the same network as {files[0]}")
    means = {name: torch.stack([state[name].double() for state in states]).mean(0) for name in sorted(states[0])}
    return {name: mean.to(states[0][name].dtype) for name, mean in means.items()}


def main() -> None:
    """Averages the files given on the command line."""
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    out, *files = map(Path, sys.argv[1:])
    print(write_bytes(out, save(average(files), metadata={"mean_of": ", ".join(file.name for file in files)})))


if __name__ == "__main__":
    main()
