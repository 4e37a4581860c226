"""More procedural scenes as a plug-in: streets, objects and landmarks besides rooms, and the flaws of photographs.

``python train.py --config-dir examples/worlds/configs data=worlds data.variant=[room,outdoor]`` trains on them. The
plane sweep in the package was trained on all of them (``recipes/sweep``).
"""

from examples.worlds.source import Worlds

__all__ = ["Worlds"]
