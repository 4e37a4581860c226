"""Loss terms that have a weight and never act."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

from torch import Tensor

log = logging.getLogger(__name__)

PATIENCE = 100  # steps


class IdleTerms:
    """Counts for how long each weighted term has been exactly zero, and says it once per term.

    Args:
        names: terms with a weight, as the loss's report names them.
        patience: steps in a row after which a term is named.
    """

    def __init__(self, names: Iterable[str], patience: int = PATIENCE) -> None:
        self.patience = patience
        self._idle = dict.fromkeys(names, 0)

    def see(self, terms: Mapping[str, Tensor]) -> None:
        """Takes the terms of one step."""
        for name in list(self._idle):
            self._idle[name] = 0 if name not in terms or float(terms[name]) else self._idle[name] + 1
            if self._idle[name] == self.patience:
                del self._idle[name]
                log.warning(
                    "the loss term %s has a weight, but was 0 in each of the last %d steps: it does not act "
                    "(depth_consistency needs rendered context views, enhance_* rests while enhancement does no harm)",
                    name,
                    self.patience,
                )
