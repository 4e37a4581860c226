"""Files of a reconstruction in windows: memory-mapped arrays of all views, and results of finished steps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.lib.format import open_memmap
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import replacing, write_json
from vg2gt.io.tensors import read_tensors
from vg2gt.model import Reconstructor

FORMAT = 1
"""Version of the folder's format; increment it when the format changes."""
SET = "set.json"  # marks the folder of a set; says whether it is finished
_PLAIN = (bool, int, float, str, tuple, type(None))


class WindowStore:
    """The folder of one image set; its content survives an interruption.

    Args:
        folder: parent folder of all sets; the folder of this set is created in it if missing.
        key: hash of the images, model and sizes of the set.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:12]
        if not (self.folder / SET).is_file():
            write_json(self.folder / SET, {"finished": False})

    def finish(self) -> None:
        """Marks the set as finished."""
        write_json(self.folder / SET, {"finished": True})

    def array(self, name: str, shape: Sequence[int] | None = None, fill: float = 0) -> Tensor:
        """Returns a memory-mapped float32 array of the folder; writing to the tensor writes to the file.

        Args:
            name: file name without extension.
            shape: shape to create the array with if it does not exist.
            fill: initial value of a new array.
        """
        path = self.folder / f"{name}.npy"
        if shape is not None and not path.is_file():
            with replacing(path) as temporary:
                made = open_memmap(temporary, "w+", np.float32, tuple(shape))
                if fill:
                    made[:] = fill
                del made
        return torch.from_numpy(open_memmap(path, "r+"))

    def has(self, name: str) -> bool:
        """Returns whether an array or a finished step of this name exists."""
        return (self.folder / f"{name}.npy").is_file() or self.step(name).is_file()

    def step(self, name: str) -> Path:
        """Returns the file of a finished step."""
        return self.folder / f"{name}.safetensors"

    def save(self, name: str, tensors: Mapping[str, Tensor]) -> None:
        """Writes the result of a step, completely or not at all."""
        with replacing(self.step(name)) as temporary:
            save_file({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, temporary)

    def load(self, name: str) -> dict[str, Tensor] | None:
        """Reads the result of a step; None if it is not finished."""
        try:
            return read_tensors(self.step(name))
        except (FileNotFoundError, FormatError):
            return None


def read_rows(file: Path, rows: slice) -> dict[str, Tensor]:
    """Reads some rows of all tensors in a finished step's file."""
    with safe_open(file, "pt") as opened:
        return {key: opened.get_slice(key)[rows] for key in opened.keys()}  # noqa: SIM118


def key_of(model: Reconstructor, *facts: object) -> str:
    """Returns a hash of a model's weights and options, and of further facts (JSON values)."""
    digest = hashlib.sha256(json.dumps([FORMAT, model.backend.identity(), facts]).encode())
    for name, module in model.named_modules():
        options = {key: value for key, value in vars(module).items() if isinstance(value, _PLAIN) and key[0] != "_"}
        options.pop("training", None)
        digest.update(f"{name} {sorted(options.items())}".encode())
    digest.update(f"{model.visibility} {vars(model.scale)}".encode())
    for name, tensor in sorted(model.trained_state().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
