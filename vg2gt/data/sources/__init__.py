"""Datasets on disk, one file a layout; all are a ``FileSource``."""

from vg2gt.data.sources.colmap_model import COLMAP
from vg2gt.data.sources.dtu import DTU, DTUTraining
from vg2gt.data.sources.image_folder import ImageFolder
from vg2gt.data.sources.infinigen import Infinigen
from vg2gt.data.sources.kitti import KITTI
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.data.sources.replica import Replica
from vg2gt.data.sources.scannet import ScanNet, ScanNetSens
from vg2gt.data.sources.tanks_and_temples import TanksAndTemples

__all__ = [
    "COLMAP",
    "DTU",
    "KITTI",
    "DTUTraining",
    "ImageFolder",
    "Infinigen",
    "Nerfstudio",
    "Replica",
    "ScanNet",
    "ScanNetSens",
    "TanksAndTemples",
]
