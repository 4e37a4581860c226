"""Outputs of the official code, stored next to this file (see the README). Nothing is unpickled."""

import json
import lzma
from functools import cache
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load
from torch import Tensor

FOLDER = Path(__file__).parent


@cache
def read_json(name: str) -> dict[str, Any]:
    """``networks`` or ``manifests``."""
    return json.loads(lzma.decompress((FOLDER / f"{name}.json.xz").read_bytes()))


@cache
def read_cases(network: str) -> dict[str, Tensor]:
    """Inputs and outputs of every case of a network, named ``CASE.TENSOR``."""
    return load(lzma.decompress((FOLDER / f"{network}.safetensors.xz").read_bytes()))


def draw_weights(network: str) -> dict[str, Tensor]:
    """Draws a network's weights again, in the order and by the laws in which the reference drew them."""
    description = read_json("networks")[network]
    generator = torch.Generator().manual_seed(description["seed"])
    weights = {}
    for parameter in description["parameters"]:
        shape = parameter["shape"]
        if "uniform" in parameter:
            value = torch.rand(shape, generator=generator) * parameter["uniform"]
        else:
            value = torch.randn(shape, generator=generator) * parameter["normal"]
        value += parameter.get("offset", 0.0)
        if "rows" in parameter:
            first, last, factor = parameter["rows"]
            value[first:last] *= factor
        if "set" in parameter:  # drawn, then replaced
            value = torch.tensor(parameter["set"]).view(shape)
        weights[parameter["name"]] = value
    found = sum(float(value.double().abs().sum()) for value in weights.values())
    expected = description["absolute_sum"]
    assert abs(found - expected) < 1e-6 * expected, f"torch {torch.__version__} draws other weights for {network}"
    return weights
