"""Files of tensors from anywhere: nothing in them is executed, and they take no more memory than they are long."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular


def read_torch(path: str | Path) -> Any:
    """Reads a file of ``torch.save`` that holds tensors and plain values, on the CPU.

    Raises:
        FileNotFoundError: if there is none.
        FormatError: if it is damaged, holds anything else, or is compressed (``torch.save`` never does that).
    """
    path = Path(path)
    try:
        return load_plain(regular(path))
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
        # Copies: the file itself would stay mapped, and whoever writes to it would change a network that runs.
        return {name: tensor.clone() for name, tensor in load_file(regular(path)).items()}
    except SafetensorError as error:
        raise FormatError(f"{path} is damaged or no safetensors file: {error}") from error


def load_plain(path: Path) -> Any:
    """What ``torch.load`` makes of a file in which nothing is executed, compressed or shorter than it says.

    Raises:
        FormatError: if the file is no archive that ``torch.save`` writes, or a tensor's record is too short.
        Exception: whatever ``torch.load`` raises over damaged bytes.
    """
    refuse_foreign(path)
    content = torch.load(path, map_location="cpu", weights_only=True)
    refuse_short_records(path, content)
    return content


def refuse_short_records(path: Path, content: Any) -> None:
    """Refuses tensors that are longer than their records in the archive: torch 2.6 fills them with foreign memory.

    Args:
        path: the archive; files of old that are none have lengths torch knows.
        content: what was read from it.

    Raises:
        FormatError: if a tensor has no record of its length.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        records = Counter(member.file_size for member in archive.infolist() if "/data/" in member.filename)
    storages = {
        (tensor.untyped_storage().data_ptr(), tensor.untyped_storage().nbytes()) for tensor in _tensors(content)
    }
    missing = Counter(length for _, length in storages if length) - records
    if missing:
        raise FormatError(f"{path} is damaged: a tensor of {next(iter(missing))} bytes has a record of another length")


def _tensors(content: Any) -> Iterator[Tensor]:
    if isinstance(content, Tensor):
        yield content
    elif isinstance(content, Mapping):
        for value in content.values():
            yield from _tensors(value)
    elif isinstance(content, (list, tuple, set)):
        for value in content:
            yield from _tensors(value)


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
