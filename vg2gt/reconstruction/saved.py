"""Reads a scene from a reconstruction's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.io import read_cameras_json, read_gaussian_ply
from vg2gt.io.arrays import npz_names, read_npz
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json
from vg2gt.io.image_files import read_color, read_mask
from vg2gt.reconstruction.camera_paths import view_stem
from vg2gt.reconstruction.frame import SceneFrame
from vg2gt.reconstruction.output_names import PREDICTED
from vg2gt.reconstruction.scene import Scene
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

ARRAYS = ("images", "depth", "depth_conf")


def read_scene(folder: str | Path, renderer: Renderer, device: torch.device | str = "cpu") -> Scene:
    """Reads a scene that was saved with its cameras and views.

    Args:
        folder: folder with ``scene.ply``, ``cameras.json`` and ``views.npz``. Without ``views.npz``, the images that
            cameras.json names are read from ``images/``, and the scene's rendered depth replaces the decoded depth.
        renderer: renderer of the scene.
        device: device of the Gaussians and cameras.

    Raises:
        FileNotFoundError: if a file is missing; the message says how to get it.
        ValueError: if the files do not match.
    """
    folder = Path(folder)
    for name in ("scene.ply", "cameras.json"):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder} has no {name}: give a folder that vg2gt reconstruct has written")
    report = read_json(folder / "report.json") if (folder / "report.json").is_file() else {}
    gaussians = read_gaussian_ply(folder / "scene.ply").to(device)
    named = read_cameras_json(folder / "cameras.json")
    cameras = _cameras(folder, named).to(device)
    if (folder / "views.npz").is_file():
        images, depth, conf, mask = _read_views(folder / "views.npz", named, cameras.size)
    else:
        images, mask = _read_images(folder / "images", named)
        depth = _rendered_depth(renderer, gaussians, cameras)
        conf = torch.ones_like(depth)
    cameras_from, metres = str(report.get("cameras", PREDICTED)), named[0].metres_per_unit
    return Scene(
        gaussians=gaussians,
        cameras=cameras,
        images=images,
        depth=depth,
        depth_conf=conf,
        names=tuple(view_stem(camera.name) for camera in named),
        renderer=renderer,
        metres_per_unit=report.get("metres_per_unit") if metres is None else metres,
        cameras_from="" if cameras_from == PREDICTED else cameras_from,
        frame=_frame(report, named[0]),
        mask=mask,
        **_trust(folder / "views.npz", tuple(depth.shape)),  # pyright: ignore[reportArgumentType]
        poses=torch.from_numpy(np.stack([camera.world_to_camera for camera in named])),
    )


def _frame(report: dict[str, Any], camera: NamedCamera) -> SceneFrame | None:
    """Returns the frame that the scene was written in, as its target frame too."""
    if camera.similarity is None:
        return None
    name = report.get("frame")
    name = name if name in ("given", "first", "upright") else "given"
    return SceneFrame(name, camera.similarity, None, "given", name)


def _cameras(folder: Path, named: list[NamedCamera]) -> Cameras:
    sizes = sorted({(camera.height, camera.width) for camera in named})
    if len(sizes) != 1:
        raise ValueError(
            f"{folder / 'cameras.json'} has cameras of {len(sizes)} sizes {sizes[:3]}; one size is expected"
        )
    poses, intrinsics = (
        torch.from_numpy(np.stack([getattr(camera, name) for camera in named])).float()[None]
        for name in ("world_to_camera", "intrinsics")
    )
    return Cameras(poses, intrinsics, sizes[0])


def _read_views(
    path: Path, named: list[NamedCamera], size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    views, names = len(named), [view_stem(camera.name) for camera in named]
    try:
        arrays, mask = read_npz(path, ARRAYS), None
        if "mask" in npz_names(path):
            mask = torch.from_numpy(read_npz(path, ["mask"])["mask"].astype(np.float32))
        if "names" in npz_names(path) and read_npz(path, ["names"])["names"].tolist() != names:
            raise FormatError("it is of other images than cameras.json next to it")
    except (KeyError, FormatError) as error:
        raise FormatError(f"{path}: {error}; write it again with vg2gt reconstruct --save views.npz") from error
    shapes = {name: (views, *size, *([3] if name == "images" else [])) for name in ARRAYS}
    wrong = [f"{name} {array.shape}" for name, array in arrays.items() if array.shape != shapes[name]]
    if wrong or arrays["images"].dtype != np.uint8:
        raise FormatError(
            f"{path} does not belong to the {views} cameras of {size[0]}x{size[1]} next to it: "
            f"{', '.join(wrong) or 'its images are not uint8'}"
        )
    images = torch.from_numpy(arrays["images"]).permute(0, 3, 1, 2).float() / 255
    depth, conf = (torch.from_numpy(arrays[name].astype(np.float32)) for name in ("depth", "depth_conf"))
    if mask is not None and mask.shape != depth.shape:
        raise FormatError(f"{path}: mask {tuple(mask.shape)} does not belong to depth {tuple(depth.shape)}")
    return images, depth.nan_to_num(0.0, 0.0, 0.0).clamp(min=0), conf.nan_to_num(0.0, 0.0, 0.0).clamp(min=0), mask


def _trust(path: Path, shape: tuple[int, ...]) -> dict[str, Tensor]:
    """Reads ``error`` and ``support`` of the pixels, if saved."""
    names = [name for name in ("error", "support") if path.is_file() and name in npz_names(path)]
    arrays = read_npz(path, names) if names else {}
    for name, array in arrays.items():
        if array.shape != shape:
            raise FormatError(f"{path}: {name} {array.shape} does not belong to depth {shape}")
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _read_images(folder: Path, named: list[NamedCamera]) -> tuple[Tensor, Tensor | None]:
    images, masks = [], []
    for camera in named:
        path = folder / camera.name
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder.parent} has no views.npz and no images/{camera.name}, so there is nothing to refine on: "
                "reconstruct with --save scene.ply,cameras.json,views.npz"
            )
        size, pixels = (camera.height, camera.width), read_color(path, "", upright=True)
        if pixels.shape[:2] != size:
            raise ValueError(
                f"{path} has {pixels.shape[0]}x{pixels.shape[1]} pixels, its camera {size[0]}x{size[1]}; "
                "resize one of them"
            )
        images.append(torch.from_numpy(pixels).permute(2, 0, 1).float() / 255)
        mask = read_mask(path, "", upright=True)
        masks.append(torch.ones(size) if mask is None else torch.from_numpy(mask))
    weights = torch.stack(masks)
    return torch.stack(images), None if bool((weights == 1).all()) else weights


@torch.no_grad()
def _rendered_depth(renderer: Renderer, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    views = torch.arange(cameras.world_to_camera.shape[1], device=gaussians.means.device)
    return torch.cat([renderer(gaussians, cameras.select(view)).depth[0].cpu() for view in views.split(1)])
