"""Readers and writers, one module per format."""
# ruff: noqa: F401  the imports are for type checkers; names are imported on first use

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vg2gt.io.animations import write_video
    from vg2gt.io.cameras_json import NamedCamera, named_cameras, read_cameras_json, write_cameras_json
    from vg2gt.io.colmap import (
        colmap_from_views,
        colmap_images,
        colmap_intrinsics,
        colmap_pose,
        read_colmap,
        write_colmap,
    )
    from vg2gt.io.errors import FormatError
    from vg2gt.io.gaussian_files import read_gaussians, write_tiles
    from vg2gt.io.gltf import read_gaussian_gltf, write_gaussian_gltf
    from vg2gt.io.mesh import Mesh, fuse_depth, write_mesh
    from vg2gt.io.nerfstudio import Lens, Transforms, TransformsFrame, read_transforms, write_transforms
    from vg2gt.io.ply import read_gaussian_ply, write_gaussian_ply
    from vg2gt.io.points import write_point_ply
    from vg2gt.io.spz import read_spz, write_spz
    from vg2gt.io.video import read_video

_NAMES = {
    "animations": "write_video",
    "cameras_json": "NamedCamera named_cameras read_cameras_json write_cameras_json",
    "colmap": "colmap_from_views colmap_images colmap_intrinsics colmap_pose read_colmap write_colmap",
    "errors": "FormatError",
    "gaussian_files": "read_gaussians write_tiles",
    "gltf": "read_gaussian_gltf write_gaussian_gltf",
    "mesh": "Mesh fuse_depth write_mesh",
    "nerfstudio": "Lens Transforms TransformsFrame read_transforms write_transforms",
    "ply": "read_gaussian_ply write_gaussian_ply",
    "points": "write_point_ply",
    "spz": "read_spz write_spz",
    "video": "read_video",
}
_HOMES = {name: f"vg2gt.io.{file}" for file, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Imports a format's module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
