"""Loaders of datasets on disk, one module per layout; all but streams are subclasses of ``FileSource``."""

from vg2gt.data.sources.colmap_model import COLMAP
from vg2gt.data.sources.infinigen import Infinigen
from vg2gt.data.sources.kitti import KITTI
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.data.sources.replica import Replica
from vg2gt.data.sources.rgbd import ScanNet
from vg2gt.data.sources.streamed import Streamed

__all__ = [
    "COLMAP",
    "KITTI",
    "Infinigen",
    "Nerfstudio",
    "Replica",
    "ScanNet",
    "Streamed",
]
