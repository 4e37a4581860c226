"""Reading of untrusted tensor files, without executing code in them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular


def tensors_digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, shapes, types and values of tensors, sorted by name."""
    digest = hashlib.sha256()
    for key, value in sorted(state.items()):
        digest.update(f"{key} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_tensors(path: str | Path, entry: str | None = None) -> dict[str, Tensor]:
    """Reads named tensors from ``.safetensors``, or from a file of ``torch.save`` with any other suffix.

    Args:
        path: the file.
        entry: key of the tensors in a file of ``torch.save`` that holds more; it need not be there.

    Raises:
        FileNotFoundError: if the file does not exist.
        FormatError: if it is damaged or not a mapping of names to tensors.
    """
    path = Path(path)
    try:
        if path.suffix == ".safetensors":
            # clones: the file would stay mapped, and writing to it would change a loaded network
            return {name: tensor.clone() for name, tensor in load_file(regular(path)).items()}
        state = torch.load(regular(path), map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:  # damage raises various errors of safetensors, unpickler, zip reader, allocator
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise FormatError(f"{path} is damaged or holds more than tensors and plain values: {reason[0]}") from error
    if entry is not None and isinstance(state, dict) and isinstance(state.get(entry), dict):
        state = state[entry]
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise FormatError(f"{path} is not a mapping of names to tensors: export the bare state dict")
    return dict(state)
