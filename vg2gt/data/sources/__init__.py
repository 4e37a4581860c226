"""Datasets on disk, one file a layout; all are a ``FileSource``."""

from vg2gt.data.sources.colmap_model import COLMAP
from vg2gt.data.sources.kitti import KITTI

__all__ = ["COLMAP", "KITTI"]
