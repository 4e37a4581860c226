"""Which views of a scene are taken: one record (``SceneSample``), three ways to choose.

``sampling`` draws for training, ``even`` spreads for evaluation during training (``data.eval_*``), ``drawn`` draws or
reads an index for ``vg2gt evaluate`` (``evaluation.selection``).
"""

from __future__ import annotations

from dataclasses import dataclass

from vg2gt.data.framing import Framing


@dataclass(frozen=True)
class SceneSample:
    """Frames of one scene: the context views first, then the held-out target views.

    Attributes:
        scene: the scene's name.
        context: frame ids of the input views; the first is the anchor, whose camera becomes the world frame.
        target: frame ids of the held-out views, disjoint from ``context``.
        framing: size, zoom and window drawn for the scene; None: as in evaluation.
    """

    scene: str
    context: tuple[int, ...]
    target: tuple[int, ...] = ()
    framing: Framing | None = None

    @property
    def frames(self) -> tuple[int, ...]:
        """All frame ids, in the order in which a batch holds them."""
        return (*self.context, *self.target)
