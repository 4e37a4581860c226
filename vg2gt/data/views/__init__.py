"""View selection: the views of a scene (``SceneSample``) and three ways to choose them.

``sampling`` draws training views, ``even`` chooses evenly spaced views for evaluation during training
(``data.eval_*``), and ``drawn`` draws views or reads them from an index for ``vg2gt evaluate``
(``evaluation.selection``).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SceneSample:
    """Frames of one scene: the context views first, then the held-out target views.

    Attributes:
        scene: the scene's name.
        context: frame ids of the input views; the first is the anchor, whose camera becomes the world frame.
        target: frame ids of the held-out views, disjoint from ``context``.
    """

    scene: str
    context: tuple[int, ...]
    target: tuple[int, ...] = ()

    @property
    def frames(self) -> tuple[int, ...]:
        """All frame ids, in the order of the batch."""
        return (*self.context, *self.target)
