"""Readers and writers, one file per format."""

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
