"""Scenes made in the background before they are asked for, while the processor has nothing else for its other cores."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterable

from vg2gt.data.base import SceneSource

log = logging.getLogger(__name__)


class ScenesAhead:
    """Lets sources make scenes (``SceneSource.prepare``) one after the other in a thread, inside a ``with`` block.

    What is made is what would be made later, so results are the same; only when it is made differs. A scene that cannot
    be made is left to whoever loads it, who then names the fault.

    Args:
        scenes: sources and names, in the order in which they will be needed.
    """

    def __init__(self, scenes: Iterable[tuple[SceneSource, str]]) -> None:
        self._waiting = deque(scenes)
        self._working: tuple[SceneSource, str] | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="vg2gt-scenes-ahead", daemon=True)

    def __enter__(self) -> ScenesAhead:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ends after the scene that is being made."""
        with self._changed:
            self._waiting.clear()
        self._thread.join()

    def claim(self, source: SceneSource, scene: str) -> None:
        """Called before a scene is loaded: takes it off the list, or waits while it is being made."""
        with self._changed:
            if (source, scene) in self._waiting:
                self._waiting.remove((source, scene))
            self._changed.wait_for(lambda: self._working != (source, scene))

    def _work(self) -> None:
        while True:
            with self._changed:
                self._working = self._waiting.popleft() if self._waiting else None
                self._changed.notify_all()
            if self._working is None:
                return
            source, scene = self._working
            try:
                source.prepare(scene)
            except Exception as error:  # whoever loads the scene meets it again and says so
                log.debug("scene %s was not made ahead: %s", scene, error)
