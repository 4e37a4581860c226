"""Readers and writers, one file a format."""

from vg2gt.io.colmap import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    colmap_camera,
    colmap_from_views,
    colmap_image,
    colmap_intrinsics,
    colmap_pose,
    read_colmap,
    write_colmap,
)
from vg2gt.io.errors import FormatError
from vg2gt.io.nerfstudio import Lens, Transforms, TransformsFrame, read_transforms, write_transforms

__all__ = [
    "ColmapCamera",
    "ColmapImage",
    "ColmapModel",
    "ColmapPoints",
    "FormatError",
    "Lens",
    "Transforms",
    "TransformsFrame",
    "colmap_camera",
    "colmap_from_views",
    "colmap_image",
    "colmap_intrinsics",
    "colmap_pose",
    "read_colmap",
    "read_transforms",
    "write_colmap",
    "write_transforms",
]
