"""Datasets: one interface (``SceneSource``), its loaders, view sampling and the data module."""

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.data.mixture import Mixture
from vg2gt.data.sharded_scenes import ShardedScenes
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.synthetic import SyntheticScenes

__all__ = [
    "DataError",
    "Frames",
    "Mixture",
    "RGBDFolder",
    "SceneDataModule",
    "SceneSource",
    "ShardedScenes",
    "SyntheticScenes",
]
