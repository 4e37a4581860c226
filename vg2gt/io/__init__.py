"""Readers and writers, one module per format."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vg2gt.io.cameras_json import NamedCamera, named_cameras, read_cameras_json, write_cameras_json
    from vg2gt.io.colmap import (
        colmap_from_views,
        colmap_images,
        colmap_intrinsics,
        colmap_pose,
        read_colmap,
        write_colmap,
    )
    from vg2gt.io.compressed_ply import write_compressed_ply
    from vg2gt.io.errors import FormatError
    from vg2gt.io.gaussian_files import read_gaussians, write_gaussians
    from vg2gt.io.gaussian_glb import read_gaussian_glb, write_gaussian_glb
    from vg2gt.io.glb import write_glb
    from vg2gt.io.mesh import Mesh, fuse_depth, write_mesh
    from vg2gt.io.nerfstudio import Lens, Transforms, TransformsFrame, read_transforms, write_transforms
    from vg2gt.io.ply import ColoredPoints, read_gaussian_ply, read_point_ply, write_gaussian_ply, write_point_ply
    from vg2gt.io.splat import read_splat, write_splat
    from vg2gt.io.spz import read_spz, write_spz
    from vg2gt.io.video import read_video, write_video

__all__ = [
    "ColoredPoints",
    "FormatError",
    "Lens",
    "Mesh",
    "NamedCamera",
    "Transforms",
    "TransformsFrame",
    "colmap_from_views",
    "colmap_images",
    "colmap_intrinsics",
    "colmap_pose",
    "fuse_depth",
    "named_cameras",
    "read_cameras_json",
    "read_colmap",
    "read_gaussian_glb",
    "read_gaussian_ply",
    "read_gaussians",
    "read_point_ply",
    "read_splat",
    "read_spz",
    "read_transforms",
    "read_video",
    "write_cameras_json",
    "write_colmap",
    "write_compressed_ply",
    "write_gaussian_glb",
    "write_gaussian_ply",
    "write_gaussians",
    "write_glb",
    "write_mesh",
    "write_point_ply",
    "write_splat",
    "write_spz",
    "write_transforms",
    "write_video",
]

_FILES: dict[str, list[str]] = {
    "vg2gt.io.cameras_json": ["NamedCamera", "named_cameras", "read_cameras_json", "write_cameras_json"],
    "vg2gt.io.colmap": [
        "colmap_from_views",
        "colmap_images",
        "colmap_intrinsics",
        "colmap_pose",
        "read_colmap",
        "write_colmap",
    ],
    "vg2gt.io.compressed_ply": ["write_compressed_ply"],
    "vg2gt.io.errors": ["FormatError"],
    "vg2gt.io.gaussian_files": ["read_gaussians", "write_gaussians"],
    "vg2gt.io.gaussian_glb": ["read_gaussian_glb", "write_gaussian_glb"],
    "vg2gt.io.glb": ["write_glb"],
    "vg2gt.io.mesh": ["Mesh", "fuse_depth", "write_mesh"],
    "vg2gt.io.nerfstudio": ["Lens", "Transforms", "TransformsFrame", "read_transforms", "write_transforms"],
    "vg2gt.io.ply": ["ColoredPoints", "read_gaussian_ply", "read_point_ply", "write_gaussian_ply", "write_point_ply"],
    "vg2gt.io.splat": ["read_splat", "write_splat"],
    "vg2gt.io.spz": ["read_spz", "write_spz"],
    "vg2gt.io.video": ["read_video", "write_video"],
}
_HOMES = {name: file for file, names in _FILES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Imports a format's module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
