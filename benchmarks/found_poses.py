"""Poses of a recording's frames found anew from its images, intrinsics as recorded: are its own poses right?"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap  # pyright: ignore[reportMissingImports]
import torch
from PIL import Image
from torch import Tensor

from vg2gt.data.base import Frames, SceneSource
from vg2gt.data.transforms import to_bytes
from vg2gt.geometry.alignment import align_points
from vg2gt.geometry.cameras import camera_centers
from vg2gt.types import Batch, Cameras


def found_poses(source: SceneSource, scene: str) -> dict[int, Tensor]:
    """World-to-camera poses ``[4, 4]`` by structure from motion, in the unit of the recording's poses, by frame id."""
    ids = list(source.frames(scene))
    frames = source.load(scene, ids)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for number, image in zip(ids, frames.images, strict=True):
            Image.fromarray(to_bytes(image).permute(1, 2, 0).numpy()).save(folder / f"{number:08d}.png")
        poses = _mapped(folder, frames.intrinsics[0])
    kept = [number for number in ids if number in poses]
    found = torch.stack([poses[number] for number in kept])
    similarity = align_points(_centers(found, frames), _centers(frames.world_to_camera[_rows(ids, kept)], frames))
    found[:, :3, 3] *= similarity.scale.to(found.dtype)
    return dict(zip(kept, found.float(), strict=True))


def with_poses(batch: Batch, poses: dict[int, Tensor]) -> Batch:
    """A batch of one scene with other poses; only their relation within the batch matters.

    Raises:
        KeyError: if a view has none.
    """
    found = torch.stack([poses[number] for number in batch.frame_ids[0].tolist()])
    return replace(batch, cameras=replace(batch.cameras, world_to_camera=found[None]))


def pose_changes(before: Cameras, after: Cameras) -> tuple[float, float]:
    """By how many degrees, and by what share of the largest distance of two cameras, poses in view 0's frame differ."""
    first, second = (c.world_to_camera @ torch.linalg.inv(c.world_to_camera[:, :1]) for c in (before, after))
    turned = (first[..., :3, :3] @ second[..., :3, :3].mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.rad2deg(((turned - 1) / 2).clamp(-1, 1).arccos()).max()
    centers = camera_centers(Cameras(first, before.intrinsics, before.size))
    moved = (centers - camera_centers(Cameras(second, after.intrinsics, after.size))).norm(dim=-1).max()
    return float(angle), float(moved / torch.cdist(centers, centers).max())


def _rows(ids: list[int], kept: list[int]) -> list[int]:
    return [ids.index(number) for number in kept]


def _centers(poses: Tensor, frames: Frames) -> Tensor:
    intrinsics = frames.intrinsics[:1].expand(len(poses), -1, -1)[None]
    return camera_centers(Cameras(poses[None], intrinsics, (1, 1))).double()


def _mapped(folder: Path, intrinsics: Tensor) -> dict[int, Tensor]:
    """Incremental mapping of all images of a folder, with one known pinhole."""
    database = folder / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    # COLMAP's pixel centres are at one half.
    parameters = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5]
    reader.camera_params = ",".join(str(float(value)) for value in parameters)
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, folder, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader)
    pycolmap.match_exhaustive(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, folder, folder, options)
    model = max(models.values(), key=lambda some: some.num_reg_images())
    poses = {}
    for image in model.images.values():
        if image.has_pose:
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().matrix()
            poses[int(Path(image.name).stem)] = torch.from_numpy(pose)
    return poses
