"""COLMAP models, text and binary: cameras, posed images, sparse points.

The records hold the files' own numbers, so that reading and writing is exact. Our conventions come in at four named
places only: :func:`colmap_intrinsics` and :func:`colmap_camera` move the principal point by half a pixel (COLMAP has
the centre of the first pixel at (1/2, 1/2), we at (0, 0)), :func:`colmap_pose` and :func:`colmap_image` turn COLMAP's
quaternion and translation into our ``world_to_camera`` and back (both are OpenCV cameras).

Example:
    >>> import numpy as np, tempfile
    >>> from vg2gt.io import colmap_camera, colmap_image, colmap_intrinsics, read_colmap, write_colmap
    >>> from vg2gt.io import ColmapModel, ColmapPoints
    >>> intrinsics = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    >>> camera = colmap_camera(1, intrinsics, size=(480, 640))
    >>> image = colmap_image(1, np.eye(4), camera.id, "room/0001.png")
    >>> model = ColmapModel({1: camera}, {1: image}, ColmapPoints.empty())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     model = read_colmap(write_colmap(folder, model))
    >>> model.cameras[1].params, model.images[1].name
    ((500.0, 500.0, 320.0, 240.0), 'room/0001.png')
    >>> bool((colmap_intrinsics(model.cameras[1]) == intrinsics).all())
    True
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.io import colmap_binary, colmap_text
from vg2gt.io.colmap_records import (
    CAMERA_MODELS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    check_camera,
)
from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_bytes
from vg2gt.types import Cameras

PIXEL_CENTER = 0.5  # where COLMAP has the centre of the first pixel; ours is at 0

_FILES = ("cameras", "images", "points3D")
Numbered = TypeVar("Numbered", ColmapCamera, ColmapImage)


def read_colmap(folder: str | Path) -> ColmapModel:
    """Reads a model, binary if its three ``.bin`` files are there and text (``.txt``) otherwise.

    Args:
        folder: the folder with ``cameras``, ``images`` and ``points3D``, usually ``sparse/0``. Newer files beside them
            (``rigs``, ``frames``) only repeat the poses and are not needed.

    Returns:
        The model, in COLMAP's conventions. Poses may hold NaN if the file does: see :func:`colmap_pose`.

    Raises:
        FormatError: if there is no model, or if a file is damaged, naming the file, the place and what is wrong.
    """
    folder = Path(folder)
    for ending, reader in ((".bin", colmap_binary), (".txt", colmap_text)):
        paths = [folder / f"{name}{ending}" for name in _FILES]
        if all(path.is_file() for path in paths):
            model = ColmapModel(
                _by_id(reader.read_cameras(paths[0]), paths[0]),
                _by_id(reader.read_images(paths[1]), paths[1]),
                reader.read_points(paths[2]),
            )
            _check_references(model, paths[1], paths[2])
            return model
    names = ", ".join(_FILES)
    raise FormatError(
        f"{folder}: no COLMAP model here, expected {names} all as .bin or all as .txt; give the model's own folder, "
        "usually sparse/0"
    )


def write_colmap(folder: str | Path, model: ColmapModel, *, text: bool = False) -> Path:
    """Writes a model; each file appears whole or not at all. Reading it back gives the same numbers exactly.

    Args:
        folder: made if needed. Files of the other kind already there would be read instead or beside: they are refused.
        model: what to write; not changed.
        text: True writes ``.txt``, False ``.bin``.

    Returns:
        The folder.

    Raises:
        ValueError: if the model contradicts itself, or a name cannot be written.
        FileExistsError: if the folder holds a model of the other kind.
    """
    folder = Path(folder)
    _check_writable(model)
    writer, ending, other = (colmap_text, ".txt", ".bin") if text else (colmap_binary, ".bin", ".txt")
    for name in _FILES:
        if (folder / f"{name}{other}").exists():
            raise FileExistsError(f"{folder} holds {name}{other} of another model; write to an empty folder")
    contents = (
        writer.cameras_content(list(model.cameras.values())),
        writer.images_content(list(model.images.values())),
        writer.points_content(model.points),
    )
    for name, content in zip(_FILES, contents, strict=True):
        write_bytes(folder / f"{name}{ending}", content)
    return folder


def colmap_intrinsics(camera: ColmapCamera) -> NDArray[np.float64]:
    """Pinhole part of a camera ``[3, 3]`` in pixels, with our integer pixel centres; distortion is left out.

    Raises:
        ValueError: if the camera model has no focal length (EQUIRECTANGULAR).
    """
    if "cx" not in CAMERA_MODELS[camera.model][1]:
        raise ValueError(f"camera {camera.id}: {camera.model} has no pinhole part; reproject the images to PINHOLE")
    fx, fy, cx, cy = (camera.param(name) for name in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0, cx - PIXEL_CENTER], [0, fy, cy - PIXEL_CENTER], [0, 0, 1]])


def colmap_camera(number: int, intrinsics: ArrayLike, size: tuple[int, int]) -> ColmapCamera:
    """PINHOLE camera of our intrinsics ``[3, 3]`` (integer pixel centres) and image ``(height, width)``."""
    k = np.asarray(intrinsics, np.float64)
    params = (k[0, 0], k[1, 1], k[0, 2] + PIXEL_CENTER, k[1, 2] + PIXEL_CENTER)
    return ColmapCamera(number, "PINHOLE", int(size[1]), int(size[0]), tuple(float(value) for value in params))


def colmap_pose(image: ColmapImage) -> NDArray[np.float64]:
    """``world_to_camera`` ``[4, 4]`` of an image; all NaN where its quaternion is zero or anything is not finite."""
    values = np.array((*image.quat, *image.translation))
    if not np.isfinite(values).all() or not np.abs(values[:4]).max() > 0:
        return np.full((4, 4), np.nan)
    pose = np.eye(4)
    # divided by the largest component first: squares of extreme values would overflow or vanish
    pose[:3, :3] = quat_to_matrix(torch.from_numpy(values[:4] / np.abs(values[:4]).max())).numpy()
    pose[:3, 3] = values[4:]
    return pose


def colmap_image(number: int, world_to_camera: ArrayLike, camera_id: int, name: str) -> ColmapImage:
    """Image without features at a rigid pose ``world_to_camera`` ``[4, 4]``."""
    pose = np.asarray(world_to_camera, np.float64)
    qw, qx, qy, qz = matrix_to_quat(torch.from_numpy(pose[:3, :3].copy())).tolist()
    tx, ty, tz = pose[:3, 3].tolist()
    return ColmapImage(number, (qw, qx, qy, qz), (tx, ty, tz), camera_id, name, np.zeros((0, 2)), np.zeros(0, np.int64))


def colmap_from_views(
    cameras: Cameras,
    names: Sequence[str],
    positions: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    sources: tuple[ArrayLike, ArrayLike] | None = None,
) -> ColmapModel:
    """Model of one scene's views, one PINHOLE camera each, numbered from 1, and points seen in them.

    Args:
        cameras: one scene (B = 1) with V views.
        names: V file names relative to the image folder.
        positions: ``[N, 3]`` world positions; None for no points.
        colors: ``[N, 3]`` uint8; None is mid grey.
        sources: where each point comes from: its view ``[N]`` and the pixel ``[N, 2]`` as (x, y), integer centres;
            becomes the point's only observation. None leaves points without observations.

    Returns:
        The model, in COLMAP's conventions.

    Raises:
        ValueError: if the shapes disagree.
    """
    poses, intrinsics = (
        tensor.detach().cpu().double().numpy() for tensor in (cameras.world_to_camera, cameras.intrinsics)
    )
    if len(poses) != 1 or poses.shape[1] != len(names):
        raise ValueError(
            f"expected one scene with as many views as names ({len(names)}), got cameras of shape "
            f"{list(poses.shape[:2])}; use Cameras.scene"
        )
    xyz = np.zeros((0, 3)) if positions is None else np.asarray(positions, np.float64)
    rgb = np.full(xyz.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"positions must be [N, 3] and colors uint8 [N, 3], got {list(xyz.shape)} and {rgb.dtype} {list(rgb.shape)}"
        )
    ids = np.arange(1, len(xyz) + 1)
    images = [
        colmap_image(i + 1, pose, i + 1, name) for i, (pose, name) in enumerate(zip(poses[0], names, strict=True))
    ]
    tracks, lengths = np.zeros((0, 2), np.int64), np.zeros(len(xyz), np.int64)
    if sources is not None:
        views, pixels = np.asarray(sources[0], np.int64), np.asarray(sources[1], np.float64)
        if views.shape != (len(xyz),) or pixels.shape != (len(xyz), 2):
            raise ValueError(f"sources must be [N] and [N, 2] for {len(xyz)} points, got {views.shape}, {pixels.shape}")
        rows = np.zeros(len(xyz), np.int64)
        for view, image in enumerate(images):
            seen = np.flatnonzero(views == view)
            rows[seen] = np.arange(len(seen))
            images[view] = replace(image, points2d=pixels[seen] + PIXEL_CENTER, point3d_ids=ids[seen])
        tracks, lengths = np.stack((views + 1, rows), -1), np.ones(len(xyz), np.int64)
    return ColmapModel(
        {i + 1: colmap_camera(i + 1, k, cameras.size) for i, k in enumerate(intrinsics[0])},
        {image.id: image for image in images},
        ColmapPoints(ids, xyz, rgb, np.full(len(xyz), -1.0), tracks, lengths),
    )


def _by_id(records: list[Numbered], path: Path) -> dict[int, Numbered]:
    by_id = {record.id: record for record in records}
    if len(by_id) != len(records):
        raise FormatError(f"{path}: {len(records) - len(by_id)} numbers occur twice; the file is damaged")
    return by_id


def _check_references(model: ColmapModel, images: Path, points: Path) -> None:
    """Every number that a file refers to must exist; features and tracks are compared by their ends only."""
    for image in model.images.values():
        if image.camera_id not in model.cameras:
            raise FormatError(f"{images}: image {image.id} ({image.name}) names camera {image.camera_id}, not a camera")
    if len(np.unique(model.points.ids)) != len(model.points):
        raise FormatError(f"{points}: a point number occurs twice; the file is damaged")
    sizes = {image.id: len(image.points2d) for image in model.images.values()}
    numbers, which = np.unique(model.points.tracks[:, 0], return_inverse=True)
    limits = np.array([sizes.get(number, 0) for number in numbers.tolist()], np.int64)
    bad = np.flatnonzero(model.points.tracks[:, 1] >= limits[which]) if len(numbers) else np.zeros(0, np.int64)
    if len(bad):
        number, row = model.points.tracks[bad[0]].tolist()
        raise FormatError(f"{points}: a track names feature {row} of image {number}, which {images.name} does not have")


def _check_writable(model: ColmapModel) -> None:
    for number, camera in model.cameras.items():
        check_camera(camera, f"camera {number}")
    numbered = (*model.cameras.items(), *model.images.items())
    for number, record in numbered:
        if record.id != number or not 0 <= number < 1 << 32:
            raise ValueError(f"{record.id} stands under number {number}; numbers must agree and fit into 32 bits")
    for number, image in model.images.items():
        if image.camera_id not in model.cameras:
            raise ValueError(f"image {number} names camera {image.camera_id}, which the model does not have")
        if not image.name or "\0" in image.name or "\n" in image.name:
            raise ValueError(f"image {number} is called {image.name!r}; a name must not be empty or hold a line break")
        if image.points2d.shape != (len(image.point3d_ids), 2):
            raise ValueError(f"image {number}: points2d {image.points2d.shape}, expected {len(image.point3d_ids), 2}")
    observations, expected = len(model.points.tracks), model.points.track_lengths.sum()
    if observations != expected:
        raise ValueError(f"track_lengths sum to {expected}, but tracks have {observations} rows; they must agree")
