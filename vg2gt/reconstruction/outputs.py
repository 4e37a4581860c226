"""Writes the named outputs of a scene."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import unproject
from vg2gt.io import (
    Lens,
    Transforms,
    TransformsFrame,
    colmap_from_views,
    fuse_depth,
    write_cameras_json,
    write_colmap,
    write_gaussian_ply,
    write_glb,
    write_mesh,
    write_point_ply,
    write_spz,
    write_tiles,
    write_transforms,
)
from vg2gt.io.files import write_bytes, write_json
from vg2gt.io.images import to_pixels, write_png
from vg2gt.io.video import require_pyav
from vg2gt.reconstruction.camera_paths import orbit
from vg2gt.reconstruction.export import exported_views
from vg2gt.reconstruction.maps import AddView, animation, feed, map_sinks, whole_folder
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.output_names import DEFAULT, FPS, MAPS, ORBIT_FRAMES, OUTPUTS, PREDICTED, REFINED
from vg2gt.reconstruction.refined import before_and_after, refinement_figures
from vg2gt.reconstruction.report import html_rows, pictured, png_report, write_html_report
from vg2gt.reconstruction.trust import trust_figures
from vg2gt.uncertainty import Status, point_support

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

MESH_PIXELS = 2.0  # edge of a mesh voxel, in pixels at the median depth
_MESH_DEPTHS = 10.0  # maximum depth of the mesh, in median depths


def check_outputs(outputs: Sequence[str], known: Mapping[str, str] = OUTPUTS) -> None:
    """Checks names of outputs.

    Raises:
        ValueError: if a name is unknown or the list is empty; the message lists the known names.
    """
    for output in outputs or [""]:
        if output not in known:
            raise ValueError(f"unknown output {output!r}; choose from: {', '.join(known)}")


def check_folder(folder: str | Path, outputs: Sequence[str], overwrite: bool) -> Path:
    """Checks that the outputs can be written into a folder, which need not exist; creates nothing.

    Raises:
        FileExistsError: if an output exists and ``overwrite`` is false.
        PermissionError: if the folder cannot be created or written to.
    """
    folder = Path(folder).expanduser()
    place = next(place for place in (folder, *folder.parents) if place.exists())
    if not place.is_dir():
        raise PermissionError(f"the output folder {folder} cannot be made ({place} is a file); choose another")
    if not os.access(place, os.W_OK | os.X_OK):
        raise PermissionError(f"the output folder {folder} is not writable; choose another")
    there = [target for target in (folder / _target(output) for output in outputs) if target.exists()]
    if there and not overwrite:
        raise FileExistsError(f"{there[0]} already exists; choose another folder or add --overwrite")
    return folder


def prepare_folder(folder: str | Path, outputs: Sequence[str], overwrite: bool) -> Path:
    """Creates the output folder after :func:`check_folder`.

    Raises:
        FileExistsError: if an output exists and ``overwrite`` is false.
        PermissionError: if the folder cannot be created or written to.
    """
    folder = check_folder(folder, outputs, overwrite)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PermissionError(
            f"the output folder {folder} cannot be made ({error.strerror}); choose another"
        ) from error
    return folder


def write_outputs(
    scene: Scene,
    folder: str | Path,
    outputs: Sequence[str] = DEFAULT,
    *,
    overwrite: bool = False,
    frames: int = ORBIT_FRAMES,
    mesh_voxel: float | None = None,
    figures: Mapping[str, Any] | None = None,
    monitor: Monitor | None = None,
) -> Path:
    """Writes outputs of a scene, each file or folder completely or not at all.

    Args:
        scene: scene to write.
        folder: output folder, created if missing.
        outputs: names from :data:`OUTPUTS`.
        overwrite: replace existing outputs.
        frames: number of frames of the orbit.
        mesh_voxel: edge of the mesh voxels in scene units; None: two pixels at the median depth.
        figures: entries of ``report.json`` and ``report.html`` in addition to those of the scene.
        monitor: shows and times the stages.

    Raises:
        FileExistsError: if an output exists and ``overwrite`` is false.
        PermissionError: if the folder cannot be written to.
        ImportError: if an animation needs PyAV and it is not installed.
        ValueError: if an output is unknown.
    """
    check_outputs(outputs)
    pictures = [REFINED] if scene.refined is not None else []
    folder = prepare_folder(folder, [*outputs, *pictures], overwrite)
    monitor = monitor or Monitor()
    if "orbit.mp4" in outputs:
        require_pyav("writing orbit.mp4")
    plain = [output for output in outputs if output in _WRITERS]
    if plain:
        with monitor.stage("write files", len(plain)) as advance:
            for output in plain:
                _WRITERS[output](scene, folder / _target(output))
                advance()
    sinks = map_sinks(folder, outputs)
    if meshes := [folder / output for output in outputs if output.startswith("mesh")]:
        sinks.append(mesh_fusion(scene, meshes, mesh_voxel))
    if "report.png" in outputs:
        sinks.append(png_report(scene, folder / "report.png"))
    for name in pictures:
        write_png(folder / name, before_and_after(scene))
    rows: list[str] = []
    if "report.html" in outputs:
        sinks.append(html_rows(scene, rows))
    if sinks:
        cameras = scene.named_cameras()
        if "report.png" in outputs and len(sinks) == 1:
            cameras = [cameras[view] for view in pictured(scene)]
        with monitor.stage("render views", len(cameras)) as advance:
            feed(scene.render(cameras), sinks, advance)
    if orbits := [folder / output for output in outputs if output.startswith("orbit")]:
        path = orbit(scene.named_cameras(), float(scene.depth[scene.depth > 0].median()), frames)
        with monitor.stage("render orbit", len(path)) as advance:
            feed(scene.render(path), [animation(file, FPS) for file in orbits], advance)
    facts = {**scene_figures(scene), **(figures or {}), **cost_figures(monitor)}
    if "report.html" in outputs:
        gif = folder / "orbit.gif" if "orbit.gif" in outputs else None
        picture = folder / REFINED if pictures else None
        write_html_report(folder / "report.html", rows, facts, gif, picture)
    if "report.json" in outputs:
        write_json(folder / "report.json", facts)
    return folder


def scene_figures(scene: Scene) -> dict[str, Any]:
    """Returns the report entries of a scene."""
    height, width = scene.cameras.size
    return {
        "views": len(scene.names),
        "size": [height, width],
        "gaussians": len(scene.gaussians),
        "metres_per_unit": scene.metres_per_unit,
        "mode": scene.renderer.mode,
        **refinement_figures(scene),
        **trust_figures(scene),
        "cameras": scene.cameras_from or PREDICTED,
        **frame_figures(scene),
    }


def frame_figures(scene: Scene) -> dict[str, Any]:
    """Returns the frame and unit of a scene, and the similarity from it to the cameras as given or found."""
    if scene.frame is None:
        return {}
    matrix, scale = scene.frame.to_source, scene.frame.scale
    unit = "that of the given cameras" if scene.frame.name == "given" else "about the median depth of the views"
    similarity = {"scale": scale, "rotation": (matrix[:3, :3] / scale).tolist(), "translation": matrix[:3, 3].tolist()}
    return {"frame": scene.frame.name, "unit": unit, "similarity_to_cameras": similarity}


def cost_figures(monitor: Monitor) -> dict[str, Any]:
    """Returns time by stage, peak memory and device."""
    seconds = {name: round(value, 3) for name, value in monitor.seconds.items()}
    return {"seconds": seconds, "peak_memory_mib": round(monitor.peak_memory_mib), "device": str(monitor.device)}


@contextmanager
def mesh_fusion(scene: Scene, paths: Sequence[Path], voxel_size: float | None) -> Iterator[AddView]:
    """Collects the rendered depth and colour of the views, fuses them into a mesh and writes it to the paths.

    Rendered surfaces that no view has measured are left out.

    Raises:
        ValueError: if no view has rendered depth.
    """
    kept: list[tuple[Tensor, Tensor]] = []
    yield lambda view: kept.append((view.depth, view.color))
    depth, colors = (torch.stack(maps) for maps in zip(*kept, strict=True))
    if not (depth > 0).any():
        raise ValueError("cannot create a mesh: no view has rendered depth; remove mesh from the outputs (--save)")
    median = float(depth[depth > 0].median())
    depth = torch.where(depth < _MESH_DEPTHS * median, depth, 0)
    if scene.support is not None:
        depth = torch.where(_measured(scene, depth), depth, 0)
    focal = float(scene.cameras.intrinsics[..., [0, 1], [0, 1]].mean())
    mesh = fuse_depth(depth, scene.cameras, colors, voxel_size=voxel_size or MESH_PIXELS * median / focal)
    for path in paths:
        write_mesh(path, mesh)


def _measured(scene: Scene, depth: Tensor) -> Tensor:
    """Returns where rendered depth ``[V, H, W]`` was measured by a view, rather than background or a guess."""
    cameras = scene.cameras.to("cpu")
    points = unproject(depth[None], cameras)[0]
    status = torch.stack([point_support(view.flatten(0, 1), scene.depth, cameras)[0] for view in points])
    return status.view_as(depth) >= Status.SINGLE


def _images(scene: Scene, target: Path) -> None:
    with whole_folder(target) as folder:
        for name, image in zip(scene.names, scene.images, strict=True):
            write_png(folder / f"{name}.png", image)


def _views(scene: Scene, path: Path) -> None:
    """Writes the arrays of the views.

    ``names [V]`` are those of the views; ``images [V, H, W, 3]`` is uint8; ``depth``, ``depth_conf`` and, if known,
    ``mask`` and ``error`` are float32 ``[V, H, W]``; ``support [V, H, W]``, if known, is uint8.
    """
    buffer = io.BytesIO()
    images = np.stack([to_pixels(image) for image in scene.images])
    arrays = {
        "names": np.array(scene.names),
        "images": images,
        "depth": scene.depth.numpy(),
        "depth_conf": scene.depth_conf.numpy(),
    }
    for name in ("mask", "error", "support"):
        if (values := getattr(scene, name)) is not None:
            arrays[name] = values.numpy()
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    write_bytes(path, buffer.getvalue())


def _colmap(scene: Scene, target: Path, whole: bool = True) -> None:
    exported = exported_views(scene, whole)
    points, sources = scene.points(), exported.observations(scene)
    model = colmap_from_views(
        exported.cameras, exported.names, points.positions, points.colors, sources, exported.sizes
    )
    with whole_folder(target) as folder:
        exported.write_images(folder / "images")
        write_colmap(folder / "sparse" / "0", model)


def _nerfstudio(scene: Scene, target: Path, whole: bool = True) -> None:
    exported = exported_views(scene, whole)
    poses, intrinsics = (t[0].double().numpy() for t in (exported.cameras.world_to_camera, exported.cameras.intrinsics))
    frames = [
        TransformsFrame(f"images/{name}", pose, Lens.from_intrinsics(k, size))
        for name, pose, k, size in zip(exported.names, poses, intrinsics, exported.sizes, strict=True)
    ]
    with whole_folder(target) as folder:
        exported.write_images(folder / "images")
        _points_ply(scene, folder / "points.ply")
        write_transforms(folder / "transforms.json", Transforms(tuple(frames), ply_file_path="points.ply"))


def _tiles(scene: Scene, target: Path) -> None:
    with whole_folder(target) as folder:
        write_tiles(folder, scene.gaussians)


def _scene_ply(scene: Scene, path: Path) -> None:
    """Writes the Gaussians with ``support`` and ``error``, as far as known."""
    known = {name: values.numpy() for name, values in (scene.gaussian_trust or {}).items()}
    write_gaussian_ply(path, scene.gaussians, extra=known)


def _points_ply(scene: Scene, path: Path) -> None:
    points = scene.points()
    write_point_ply(path, points.positions, points.colors)


def _points_glb(scene: Scene, path: Path) -> None:
    points = scene.points()
    write_glb(path, points.positions, points.colors, scene.cameras)


def _target(output: str) -> str:
    """Returns the file or folder name of an output."""
    return os.path.splitext(output)[0] if output in MAPS else output


_WRITERS: dict[str, Callable[[Scene, Path], Any]] = {
    "scene.ply": _scene_ply,
    "scene.spz": lambda scene, path: write_spz(path, scene.gaussians),
    "tiles": _tiles,
    "cameras.json": lambda scene, path: write_cameras_json(path, scene.named_cameras()),
    "points.ply": _points_ply,
    "views.npz": _views,
    "points.glb": _points_glb,
    "images": _images,
    "colmap": _colmap,
    "colmap-small": lambda scene, path: _colmap(scene, path, whole=False),
    "nerfstudio": _nerfstudio,
    "nerfstudio-small": lambda scene, path: _nerfstudio(scene, path, whole=False),
}
