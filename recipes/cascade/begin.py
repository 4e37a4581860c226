"""Begins the cascade with the weights of the plane sweep, where a layer has a counterpart of the same meaning."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from backends.cascade.network import CascadeNet
from backends.sweep.features import CONTEXT_COARSE

# module of the cascade and its counterpart
_SAME = {
    "features": "features", "matching.0.weigh": "sweep.weigh", "matching.1.weigh": "sweep.weigh",
    "matching.2.weigh": "sweep_fine.weigh", "matching.0.volume": "volume", "matching.1.volume": "volume",
    "matching.2.volume": "volume_fine", "refine": "refine", "position": "tokens.position", "blocks": "tokens.blocks",
    "head": "head", "embed.2": "tokens.embed.2",
}  # fmt: skip
_NEW = 0.3  # factor on the random weights of inputs that have no counterpart


def begin(net: CascadeNet, file: Path) -> int:
    """Copies the weights of a plane sweep; returns the number of copied values."""
    old, new, copied = load_file(file), net.state_dict(), 0
    for name, value in new.items():
        part = max((part for part in _SAME if name.startswith(f"{part}.")), key=len, default=None)
        given = old.get(_SAME[part] + name[len(part) :]) if part else None
        if name == "refine.end.weight" or name == "refine.end.bias":
            assert given is not None
            # outputs: correction, guess, gate, upsampling, features for the tokens
            value[3:39] = given[1:].to(value)
        elif name == "refine.begin.0.weight":
            assert given is not None
            value.copy_(_by_columns(value, given, {0: range(CONTEXT_COARSE), -20: range(-20, 0)}))
        elif name == "head.fine.0.weight":
            assert given is not None
            value[:, : given.shape[1]], value[:, given.shape[1] :] = given.to(value), 0
        elif given is not None and given.shape == value.shape:
            value.copy_(given)
        else:
            continue
        copied += value.numel()
    context = 4 * CONTEXT_COARSE
    weight, given = new["embed.0.weight"], old["tokens.embed.0.weight"]
    weight.mul_(_NEW)
    weight[:, :context] = given[:, :context].to(weight)
    weight[:, context + 5 : context + 21] = given[:, -16:].to(weight)
    new["embed.0.bias"].copy_(old["tokens.embed.0.bias"])
    for part in ("weight", "bias"):
        new[f"head.out.{part}"][0] = 0  # the head read other tokens: begin with the matched depth
    net.load_state_dict(new)
    return copied + weight.numel()


def _by_columns(value: Tensor, given: Tensor, places: dict[int, range]) -> Tensor:
    """The given weights for the named input channels, others small."""
    out = _NEW * value
    for first, columns in places.items():
        rows = torch.tensor(columns)
        out[:, first : (first + len(rows)) or None] = given[:, rows].to(value)
    return out
