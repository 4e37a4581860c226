"""Trained weights cast to autocast's dtype by one multi-tensor copy per part of a model, instead of one copy each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from vg2gt.geometry.precision import autocast_dtype
from vg2gt.method.sparse_conv import SubmanifoldConv3d

_CONTAINERS = (nn.Sequential, nn.ModuleList, nn.ModuleDict)
_BOTH = ("weight", "bias")
_CAST = {nn.Linear: _BOTH, nn.Conv2d: _BOTH, nn.ConvTranspose2d: _BOTH, SubmanifoldConv3d: _BOTH}
"""What autocast casts, for exactly these types: subclasses, such as
:class:`vg2gt.geometry.precision.Float32Linear`, keep their weights."""


class WeightCasts:
    """Casts the trained weights of the method's linear layers and convolutions before a training step.

    Values and gradients are those of autocast to the bit. A part is a module two levels down, such as ``coarse.ptv3``:
    its weights get their gradients together, so that DDP still exchanges them during the backward pass. Only modules of
    :mod:`vg2gt.method` take part: others, such as the backbone, may run in float32.

    Args:
        model: the model; its trained parameters must require gradients already.
    """

    def __init__(self, model: nn.Module) -> None:
        self.parts: dict[str, list[tuple[nn.Module, str]]] = {}
        for name, module in _layers(model):
            for key in _CAST[type(module)]:
                if (weight := module._parameters.get(key)) is not None and weight.requires_grad:
                    self.parts.setdefault(".".join(name.split(".")[:2]), []).append((module, key))

    @contextmanager
    def __call__(self, like: Tensor) -> Iterator[None]:
        """Within the block, the modules use the cast weights; nothing changes without autocast or gradients.

        Args:
            like: a tensor on the device of the step.
        """
        dtype = autocast_dtype(like)
        wanted = dtype != torch.float32 and torch.is_grad_enabled()
        slots = [slot for part in self.parts.values() for slot in part] if wanted else []
        weights = [module._parameters[key] for module, key in slots]
        try:
            for part in self.parts.values() if wanted else ():
                casts = _Cast.apply(dtype, *(module._parameters[key] for module, key in part))
                for (module, key), cast in zip(part, casts, strict=True):  # pyright: ignore[reportArgumentType]
                    module._parameters[key] = cast
            yield
        finally:
            for (module, key), weight in zip(slots, weights, strict=True):
                module._parameters[key] = weight


def _layers(module: nn.Module, prefix: str = "") -> Iterator[tuple[str, nn.Module]]:
    """Returns names and layers of `_CAST` in torch's containers and modules of the method."""
    for name, child in module.named_children():
        if type(child) in _CAST:
            yield prefix + name, child
        elif isinstance(child, _CONTAINERS) or type(child).__module__.startswith("vg2gt.method."):
            yield from _layers(child, f"{prefix}{name}.")


class _Cast(torch.autograd.Function):
    """Casts tensors together, and their gradients back."""

    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, *weights: Tensor) -> tuple[Tensor, ...]:
        """Returns the weights in ``dtype``."""
        ctx.set_materialize_grads(False)
        return tuple(_copies(weights, dtype))

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore
        """Returns the gradients in float32; None for weights that were not used."""
        copies = iter(_copies([grad for grad in grad_outputs if grad is not None], torch.float32))
        return None, *(None if grad is None else next(copies) for grad in grad_outputs)


def _copies(tensors: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    copies = [torch.empty_like(tensor, dtype=dtype) for tensor in tensors]
    if copies:
        torch._foreach_copy_(copies, list(tensors))  # pyright: ignore[reportPrivateImportUsage]
    return copies
