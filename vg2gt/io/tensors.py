"""Files of tensors from anywhere: nothing in them is executed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular


def tensors_digest(state: Mapping[str, Tensor]) -> str:
    """sha256 of names, shapes, types and values, in sorted order."""
    digest = hashlib.sha256()
    for key, value in sorted(state.items()):
        digest.update(f"{key} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """Reads named tensors: ``.safetensors``, or any other name for a file of ``torch.save``.

    Raises:
        FileNotFoundError: if there is none.
        FormatError: if it is damaged or not a mapping of names to tensors.
    """
    path = Path(path)
    try:
        if path.suffix == ".safetensors":
            # Copies: the file would stay mapped, and whoever writes to it would change a network that runs.
            return {name: tensor.clone() for name, tensor in load_file(regular(path)).items()}
        state = torch.load(regular(path), map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except SafetensorError as error:
        raise FormatError(f"{path} is damaged or no safetensors file: {error}") from error
    except Exception as error:  # damage raises whatever the unpickler, zip reader and allocator raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise FormatError(f"{path} is damaged or holds more than tensors and plain values: {reason[0]}") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise FormatError(f"{path} is not a mapping of names to tensors: export the bare state dict")
    return dict(state)
