"""Files of tensors from anywhere: nothing in them is executed, and they take no more memory than they are long."""

from __future__ import annotations

import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from vg2gt.io.errors import FormatError


def read_torch(path: str | Path) -> Any:
    """Reads a file of ``torch.save`` that holds tensors and plain values, on the CPU.

    Raises:
        FileNotFoundError: if there is none.
        FormatError: if it is damaged, holds anything else, or is compressed (``torch.save`` never does that).
    """
    path = Path(path)
    try:
        refuse_foreign(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (FileNotFoundError, FormatError):
        raise
    except Exception as error:  # damage raises whatever the unpickler, zip reader and allocator raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise FormatError(f"{path} is damaged or holds more than tensors and plain values: {reason[0]}") from error


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """Reads named tensors: ``.safetensors``, or any other name for a file of ``torch.save``.

    Raises:
        FileNotFoundError: if there is none.
        FormatError: if it is damaged or not a mapping of names to tensors.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        state = read_torch(path)
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise FormatError(f"{path} is not a mapping of names to tensors: export the bare state dict")
        return dict(state)
    try:
        return load_file(path)
    except SafetensorError as error:
        raise FormatError(f"{path} is damaged or no safetensors file: {error}") from error


def refuse_foreign(path: Path) -> None:
    """Refuses archives that ``torch.save`` never writes.

    A compressed one could unpack to a thousand times its size, names that lead out of the archive have no use in it,
    and one of TorchScript holds programs.

    Raises:
        FormatError: naming what is in it.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED or member.file_size > member.compress_size:
                raise FormatError(f"{path} is no file of torch.save: {member.filename} in it is compressed")
            if member.filename.startswith("/") or ".." in PurePosixPath(member.filename).parts:
                raise FormatError(f"{path} is no file of torch.save: {member.filename} in it leads out of the file")
            if member.filename.endswith("/constants.pkl"):
                raise FormatError(f"{path} holds programs besides tensors (TorchScript): export the bare state dict")
