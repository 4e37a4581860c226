"""Reads a scene from a reconstruction's folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vg2gt.inputs.camera_files import view_stem
from vg2gt.io import read_cameras_json, read_gaussian_ply
from vg2gt.io.arrays import read_npz
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json
from vg2gt.io.gaussian_files import READERS
from vg2gt.outputs.output_names import PREDICTED
from vg2gt.reconstruction.frame import SceneFrame, read_place
from vg2gt.reconstruction.scene import Scene
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras

NEEDED, _KNOWN = ("images", "depth", "depth_conf"), ("names", "mask", "error", "support")


def read_scene(folder: str | Path, renderer: Renderer, device: torch.device | str = "cpu") -> Scene:
    """Reads a scene that was saved with its cameras and views.

    Args:
        folder: folder with ``scene.ply``, ``cameras.json`` and ``views.npz``.
        renderer: renderer of the scene.
        device: device of the Gaussians and cameras.

    Raises:
        FileNotFoundError: if a file is missing; the message says how to get it.
        ValueError: if the files do not match.
    """
    folder = Path(folder)
    for name in ("scene.ply", "cameras.json", "views.npz"):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder} has no {name}: give a folder that vg2gt reconstruct has written with "
                "--save scene.ply,cameras.json,views.npz"
            )
    report = read_json(folder / "report.json") if (folder / "report.json").is_file() else {}
    gaussians = read_gaussian_ply(folder / "scene.ply").to(device)
    named = read_cameras_json(folder / "cameras.json")
    sizes = sorted({(camera.height, camera.width) for camera in named})
    if len(sizes) != 1:
        raise ValueError(f"{folder / 'cameras.json'} has cameras of {len(sizes)} sizes {sizes[:3]}; one is expected")
    poses = torch.from_numpy(np.stack([camera.world_to_camera for camera in named]))
    intrinsics = torch.from_numpy(np.stack([camera.intrinsics for camera in named]))
    frame, similarity = str(report.get("frame", "given")), named[0].similarity
    cameras_from, metres = str(report.get("cameras", PREDICTED)), named[0].metres_per_unit
    return Scene(
        gaussians=gaussians,
        cameras=Cameras(poses.float()[None], intrinsics.float()[None], sizes[0]).to(device),
        **_read_views(folder / "views.npz", named, sizes[0]),
        names=tuple(view_stem(camera.name) for camera in named),
        renderer=renderer_of(folder, renderer),
        metres_per_unit=report.get("metres_per_unit") if metres is None else metres,
        cameras_from="" if cameras_from == PREDICTED else cameras_from,
        frame=None
        if similarity is None
        else SceneFrame(frame, similarity, None, frame, read_place(report, similarity)),
        poses=poses,
    )


def scene_file(path: str | Path) -> Path:
    """Returns the scene's file if ``path`` is the folder of a scene, else ``path`` itself.

    Raises:
        FileNotFoundError: if the folder has no scene.
    """
    path = Path(path).expanduser()
    if not path.is_dir():
        return path
    for name in (f"scene{suffix}" for suffix in READERS):
        if (path / name).is_file():
            return path / name
    raise FileNotFoundError(f"{path} has no scene.ply: give a scene's file or a folder with one")


def renderer_of(folder: Path, renderer: Renderer) -> Renderer:
    """Returns a renderer with the near plane and antialiasing of the scene in a folder, if its report states them."""
    file = folder / "report.json"
    report = read_json(file) if file.is_file() else None
    known = report if isinstance(report, dict) else {}
    near, antialiased = known.get("near"), known.get("antialiased")
    if isinstance(near, float) and near > 0:
        renderer = replace(renderer, near=near)
    return replace(renderer, antialiased=antialiased) if isinstance(antialiased, bool) else renderer


def _read_views(path: Path, named: list[NamedCamera], size: tuple[int, int]) -> dict[str, Any]:
    """Returns images, depth, confidence and, if saved, mask, error and support of the views."""
    try:
        arrays = read_npz(path, NEEDED, _KNOWN)
        names = arrays.pop("names", None)
        if names is not None and names.tolist() != [view_stem(camera.name) for camera in named]:
            raise FormatError("it is of other images than cameras.json next to it")
        shape = (len(named), *size)
        wrong = [f"{name} {a.shape}" for name, a in arrays.items() if a.shape != shape + (3,) * (name == "images")]
        if wrong:
            cameras = f"{len(named)} cameras of {size[0]}x{size[1]}"
            raise FormatError(f"it does not belong to the {cameras} next to it: {', '.join(wrong)}")
    except (KeyError, FormatError) as error:
        raise FormatError(f"{path}: {error}; write it again with vg2gt reconstruct --save views.npz") from error
    found = {name: torch.from_numpy(array) for name, array in arrays.items()}
    found["images"] = found["images"].permute(0, 3, 1, 2).float() / 255
    for name in ("depth", "depth_conf"):
        found[name] = found[name].float().nan_to_num(0.0, 0.0, 0.0).clamp(min=0)
    return found
