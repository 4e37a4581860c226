"""More procedural scenes as a plug-in: streets, objects and landmarks besides rooms, with photographic flaws.

``python train.py --config-dir examples/worlds/configs data=worlds data.variant=[room,outdoor]`` trains on them. The
shipped plane sweep was trained on these worlds (``recipes/sweep``).
"""

from examples.worlds.source import Worlds

__all__ = ["Worlds"]
