"""Averages weights: ``python -m recipes.sweep.average OUT FILE FILE...``.

The mean of weights that were trained further from the same start is often better than each of them (Wortsman et al.,
"Model soups", ICML 2022).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from vg2gt.io.files import write_bytes


def average(files: list[Path]) -> dict[str, Tensor]:
    """Returns the mean of the tensors of files of one network, in their data types.

    Raises:
        ValueError: if a file's tensors have other names or shapes than the first one's.
    """
    states = [load_file(file) for file in files]
    shapes = [{name: tensor.shape for name, tensor in state.items()} for state in states]
    for file, other in zip(files, shapes, strict=True):
        if other != shapes[0]:
            raise ValueError(f"{file} does not hold the same network as {files[0]}")
    return {
        name: torch.stack([state[name].double() for state in states]).mean(0).to(first.dtype)
        for name, first in sorted(states[0].items())
    }


def main() -> None:
    """Averages the files given on the command line."""
    if len(sys.argv) < 4:
        raise SystemExit(__doc__)
    out, *files = map(Path, sys.argv[1:])
    made_of = {"mean_of": ", ".join(file.name for file in files)}
    print(write_bytes(out, save(average(files), metadata=made_of)))


if __name__ == "__main__":
    main()
