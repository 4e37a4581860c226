"""Loss terms that have a weight and never act."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

log = logging.getLogger(__name__)

PATIENCE = 100  # steps
HINGES = ("enhance_depth", "enhance_point")  # zero is what they are for


class IdleTerms:
    """Counts for how long each weighted term has been exactly zero, and says it once per term; warns of no hinge.

    Args:
        names: terms with a weight, as the loss's report names them.
        patience: steps in a row after which a term is named.
    """

    def __init__(self, names: Iterable[str], patience: int = PATIENCE) -> None:
        self.patience = patience
        self._idle = dict.fromkeys(names, 0)

    def see(self, terms: Mapping[str, Tensor]) -> None:
        """Takes the terms of one step."""
        present = [name for name in self._idle if name in terms]
        # the host waits for a GPU once, not once a term
        values = torch.stack([terms[name].detach() for name in present]).tolist() if present else []
        idle = {name for name, value in zip(present, values, strict=True) if not value}
        for name in list(self._idle):
            self._idle[name] = self._idle[name] + 1 if name in idle else 0
            if self._idle[name] == self.patience:
                del self._idle[name]
                _say(name, self.patience)


def _say(name: str, steps: int) -> None:
    if name in HINGES:
        log.info("the loss term %s has rested for %d steps: enhanced tokens decode no worse than before", name, steps)
    else:
        log.warning(
            "the loss term %s has a weight, but was 0 in each of the last %d steps: it does not act "
            "(depth_consistency needs rendered context views)",
            *(name, steps),
        )
