"""Datasets: the ``SceneSource`` interface, its loaders, view sampling and the data module."""

from typing import TYPE_CHECKING, Any

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.mixture import Mixture
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.synthetic import SyntheticScenes

if TYPE_CHECKING:
    from vg2gt.data.datamodule import SceneDataModule

__all__ = [
    "DataError",
    "Frames",
    "Mixture",
    "RGBDFolder",
    "SceneDataModule",
    "SceneSource",
    "SyntheticScenes",
]


def __getattr__(name: str) -> Any:
    """Imports the data module lazily: only it needs Lightning, which takes seconds to import."""
    if name != "SceneDataModule":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from vg2gt.data.datamodule import SceneDataModule

    return SceneDataModule
