"""Muon for matrices, AdamW for all other parameters; used by the quick run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

_QUINTIC = (3.4445, -4.7750, 2.0315)  # brings singular values to 0.7-1.2 in five steps; steepest at 0
_LIKE_ADAMW = 0.2  # root mean square of AdamW's updates
TINY = 1e-7


class MuonAdamW(torch.optim.AdamW):
    """Updates matrices with Muon (orthogonalised momentum) and all other parameters with AdamW.

    A matrix ``[a, b]`` is updated by ``-lr * 0.2 sqrt(max(a, b)) O``, where O is the orthogonal factor of the Nesterov
    momentum of its gradient. Convolution kernels are flattened to ``[out, rest]``. Muon follows Jordan et al. (2024).
    The scale, which matches the size of AdamW's updates, and the weight decay follow Liu et al. (2025, Muon is Scalable
    for LLM Training).

    Args:
        params: parameters or parameter groups; must be named for ``adamw`` to match them.
        lr: learning rate of both optimisers; groups may override it.
        momentum: momentum of Muon, in [0, 1).
        adamw: first components of parameter names, such as ``coarse``, that AdamW updates whatever their shape.
        betas: AdamW's coefficients of the running averages.
        weight_decay: decoupled weight decay of both optimisers, scaled by the learning rate; groups may override it.
        fused: use AdamW's fused kernel.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 4e-3,
        momentum: float = 0.8,
        adamw: Sequence[str] = ("coarse",),
        betas: Sequence[float] = (0.9, 0.99),
        weight_decay: float = 0.05,
        fused: bool = True,
    ) -> None:
        if not 0 <= momentum < 1:
            raise ValueError(f"momentum={momentum} must be at least 0 and less than 1")
        self.momentum, self.adamw = float(momentum), tuple(adamw)
        first, second = betas
        super().__init__(params, lr=lr, betas=(first, second), weight_decay=weight_decay, fused=fused)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Takes a step; returns the closure's loss. Parameters without a gradient are unchanged."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        matrices = [(group, matrix) for group in self.param_groups for matrix in self._matrices(group)]
        updates = orthogonalized([self._nesterov(matrix) for _, matrix in matrices])
        kept = [matrix.grad for _, matrix in matrices]
        for (group, matrix), update in zip(matrices, updates, strict=True):
            size = _LIKE_ADAMW * max(update.shape) ** 0.5
            matrix.mul_(1 - group["lr"] * group["weight_decay"])
            matrix.add_(update.view_as(matrix), alpha=-group["lr"] * size)
            matrix.grad = None  # AdamW skips parameters without a gradient
        super().step()
        for (_, matrix), gradient in zip(matrices, kept, strict=True):
            matrix.grad = gradient
        return loss

    def _matrices(self, group: dict[str, Any]) -> list[Tensor]:
        """Parameters of a group that have a gradient and are updated by Muon."""
        names = group.get("param_names") or [""] * len(group["params"])
        return [
            parameter
            for name, parameter in zip(names, group["params"], strict=True)
            if parameter.grad is not None and _is_matrix(parameter) and name.partition(".")[0] not in self.adamw
        ]

    def _nesterov(self, matrix: Tensor) -> Tensor:
        """Nesterov momentum of the gradient, as ``[out, rest]``."""
        assert matrix.grad is not None
        state = self.state[matrix]
        if not state:
            state["step"] = torch.zeros(())  # AdamW expects it in every state
            state["momentum"] = torch.zeros_like(matrix)
        state["step"] += 1
        state["momentum"].lerp_(matrix.grad, 1 - self.momentum)
        return matrix.grad.lerp(state["momentum"], self.momentum).flatten(1)


def _is_matrix(parameter: Tensor) -> bool:
    return parameter.dim() > 1 and min(parameter.flatten(1).shape) > 1


def orthogonalized(matrices: Sequence[Tensor], steps: int = 5) -> list[Tensor]:
    """Returns the approximate orthogonal factors ``U V^T`` of matrices ``U S V^T``, by a quintic iteration.

    Singular values far below the largest do not reach 1. Non-finite values stay non-finite.

    Args:
        matrices: matrices ``[a, b]``, of any sizes.
        steps: number of iterations.
    """
    places = defaultdict(list)
    for place, matrix in enumerate(matrices):
        places[matrix.shape, matrix.dtype, matrix.device].append(place)
    found: dict[int, Tensor] = {}
    for together in places.values():
        stack = torch.stack([matrices[place] for place in together])
        found |= dict(zip(together, _orthogonalized(stack, steps), strict=True))
    return [found[place] for place in range(len(matrices))]


def _orthogonalized(x: Tensor, steps: int) -> Tensor:
    """:func:`orthogonalized` for a stack ``[n, a, b]``; tall matrices are transposed so that products are smaller."""
    if x.shape[1] > x.shape[2]:
        return _orthogonalized(x.mT, steps).mT
    linear, cubic, quintic = _QUINTIC
    x = x / (torch.linalg.matrix_norm(x, keepdim=True) + TINY)
    for _ in range(steps):
        square = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=cubic, alpha=quintic), x, beta=linear)
    return x
