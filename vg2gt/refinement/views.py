"""Order of the views: which a step renders, and which are left out."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

FEWEST = 4  # with fewer views, none is left out
LEFT_OUT = 8  # one view in this many is left out at a time


class ViewOrder:
    """Deals views in random order, each once before any repeats; some are left out, in rotation.

    Args:
        views: number of views.
        holdout: never deal every N-th view; None: deal all.
        seed: random seed of the order.

    Attributes:
        trained: ``[N]`` views that are dealt.
        held_out: ``[V - N]`` views that are never dealt.
    """

    def __init__(self, views: int, holdout: int | None, seed: int) -> None:
        every = torch.arange(views)
        last = torch.zeros(views, dtype=torch.bool) if holdout is None else every % holdout == holdout - 1
        self.trained, self.held_out = every[~last], every[last]
        self._generator = torch.Generator().manual_seed(seed)
        self._left_out = self._rotation()
        self._hand: list[int] = []
        self.next_round()

    def next_round(self) -> None:
        """Moves on to the next views to leave out."""
        self.left_out = next(self._left_out)

    def deal(self, count: int) -> Tensor:
        """Returns the next views, at most ``count`` different ones, sorted."""
        hidden = set(self.left_out.tolist())
        count = min(count, len(self.trained) - len(hidden))
        dealt: list[int] = []
        while len(dealt) < count:
            if not self._hand:
                order = torch.randperm(len(self.trained), generator=self._generator)
                self._hand = self.trained[order].tolist()
            view = self._hand.pop()
            if view not in hidden and view not in dealt:
                dealt.append(view)
        return torch.tensor(sorted(dealt))

    def _rotation(self) -> Iterator[Tensor]:
        if len(self.trained) < FEWEST:
            while True:
                yield self.trained[:0]
        order = self.trained[torch.randperm(len(self.trained), generator=self._generator)]
        while True:
            yield from order.split(-(-len(order) // LEFT_OUT))
