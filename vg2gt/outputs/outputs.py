"""Writes the named outputs of a scene, and what is rendered of it: a folder per kind of map, or an animation."""

from __future__ import annotations

import io
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import unproject
from vg2gt.inputs.camera_files import view_stem
from vg2gt.inputs.pictures import spread
from vg2gt.io import (
    Lens,
    Transforms,
    TransformsFrame,
    colmap_from_views,
    fuse_depth,
    read_cameras_json,
    write_cameras_json,
    write_colmap,
    write_gaussian_gltf,
    write_gaussian_ply,
    write_mesh,
    write_point_ply,
    write_spz,
    write_tiles,
    write_transforms,
)
from vg2gt.io.animations import video_writer
from vg2gt.io.errors import FormatError, some
from vg2gt.io.files import portable, whole_folder, write_bytes, write_json
from vg2gt.io.images import colorize_depth, colorize_normals, grid, to_pixels, write_png
from vg2gt.io.solid import fuse_solid
from vg2gt.monitor import Monitor
from vg2gt.outputs.export import exported_views
from vg2gt.outputs.output_names import DEFAULT, MAPS, OUTPUTS, PREDICTED, check_outputs
from vg2gt.reconstruction.frame import place_figures
from vg2gt.reconstruction.refined import refinement_figures
from vg2gt.reconstruction.trust import trust_figures, trust_picture
from vg2gt.viewer import ViewerScene, scene_title, thumbnail, write_viewer_html
from vg2gt.visibility import Status, point_support

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import RenderedView, Scene

log = logging.getLogger(__name__)

ROWS = 12  # maximum number of views in report.png
_MESH_PIXELS = 2.0  # edge of a mesh voxel, in pixels at the median depth
_LEAST_BYTES, _PHOTO_BYTES = 500_000, 300_000  # written per image: Gaussians and maps, an exported photograph
_SAME = 1e-3  # largest difference of the poses of a scene that was made again, relative to their extent
_MESH_DEPTHS = 10.0  # maximum depth of the mesh, in median depths

AddView: TypeAlias = "Callable[[RenderedView], None]"
Sink: TypeAlias = AbstractContextManager[AddView]
"""Context manager that returns a consumer of rendered views; on exit it writes what needs all views."""


def check_folder(folder: str | Path, outputs: Sequence[str], overwrite: bool) -> Path:
    """Checks that the outputs can be written into a folder, which need not exist; creates nothing.

    Raises:
        FileExistsError: if an output exists and ``overwrite`` is false.
        PermissionError: if the folder cannot be created or written to.
    """
    folder = Path(folder).expanduser()
    place = _existing(folder)
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise PermissionError(f"the output folder {folder} cannot be written to ({place}); choose another")
    there = [target for target in (folder / _target(output) for output in outputs) if target.exists()]
    if there and not overwrite:
        raise FileExistsError(f"{there[0]} already exists; choose another folder or add --overwrite")
    return folder


def _existing(folder: Path) -> Path:
    """Returns the folder, or the nearest one above it that exists."""
    return next(place for place in (folder, *folder.absolute().parents) if place.exists())


def check_space(folder: str | Path, outputs: Sequence[str], images: int) -> None:
    """Checks that the disk of an output folder, which need not exist, has room for what is surely written.

    Args:
        folder: output folder.
        outputs: names from :data:`vg2gt.outputs.output_names.OUTPUTS`.
        images: number of images.

    Raises:
        ValueError: if it has not.
    """
    folder = Path(folder).expanduser()
    scenes, photos = {"scene.ply", "views.npz"} & set(outputs), {"colmap", "nerfstudio"} & set(outputs)
    needed = images * (_LEAST_BYTES * bool(scenes) + _PHOTO_BYTES * len(photos))
    free = shutil.disk_usage(_existing(folder)).free
    if free < needed:
        raise ValueError(
            f"the disk of {folder} has {free / 1e6:.0f} MB left, but at least {needed / 1e6:.0f} MB are needed for "
            f"{images} images; delete something, or choose another folder"
        )


def write_outputs(
    scene: Scene,
    folder: str | Path,
    outputs: Sequence[str] = DEFAULT,
    *,
    overwrite: bool = False,
    mesh_voxel: float | None = None,
    figures: Mapping[str, Any] | None = None,
    monitor: Monitor | None = None,
) -> Path:
    """Writes outputs of a scene, each file or folder completely or not at all.

    Args:
        scene: scene to write.
        folder: output folder, created if missing.
        outputs: names from :data:`vg2gt.outputs.output_names.OUTPUTS`.
        overwrite: replace existing outputs.
        mesh_voxel: edge of the mesh voxels in scene units; None: two pixels at the median depth.
        figures: entries of ``report.json`` in addition to those of the scene.
        monitor: shows and times the stages.

    Raises:
        FileExistsError: if an output exists and ``overwrite`` is false.
        PermissionError: if the folder cannot be written to.
        ValueError: if an output is unknown.
    """
    check_outputs(outputs)
    folder = check_folder(folder, outputs, overwrite)
    _name_others(scene, folder, outputs)
    monitor = monitor or Monitor()
    plain = [output for output in outputs if output in _WRITERS]
    if plain:
        with monitor.stage("write files", len(plain)) as advance:
            for output in plain:
                _WRITERS[output](scene, folder / _target(output))
                advance()
    sinks = [map_folder(folder, output) for output in outputs if output in MAPS]
    if meshes := [folder / output for output in outputs if output.startswith("mesh")]:
        sinks.append(_mesh_fusion(scene, meshes, mesh_voxel))
    if sinks:
        with monitor.stage("render views", len(scene.names)) as advance:
            feed(scene.render(), sinks, advance)
    if "report.json" in outputs:
        write_json(folder / "report.json", {**_scene_figures(scene), **(figures or {}), **cost_figures(monitor)})
    return folder


def _name_others(scene: Scene, folder: Path, outputs: Sequence[str]) -> None:
    """Warns about outputs of another scene that stay in the folder, among which later commands would take some."""
    try:
        before, now = read_cameras_json(folder / "cameras.json"), scene.named_cameras()
    except (FormatError, OSError):
        return
    written = {_target(output) for output in outputs}
    others = [name for name in map(_target, OUTPUTS) if name not in written and (folder / name).exists()]
    poses = [np.array([camera.world_to_camera for camera in each]) for each in (before, now)]
    same = [view_stem(camera.name) for camera in before] == [view_stem(camera.name) for camera in now]
    if others and not (same and np.abs(poses[0] - poses[1]).max() <= _SAME * max(np.abs(poses[1]).max(), 1)):
        log.warning("%s also holds files of another scene, which later commands mix: %s; remove them or choose another "
            "folder", folder, some(others))  # fmt: skip


def _scene_figures(scene: Scene) -> dict[str, Any]:
    """Returns the report entries of a scene."""
    height, width = scene.cameras.size
    return {
        "views": len(scene.names),
        "size": [height, width],
        "gaussians": len(scene.gaussians),
        "metres_per_unit": scene.metres_per_unit,
        "mode": scene.renderer.mode,
        "near": scene.renderer.near,
        "antialiased": scene.renderer.antialiased,
        **refinement_figures(scene),
        **trust_figures(scene),
        "cameras": scene.cameras_from or PREDICTED,
        **({} if scene.frame is None else {"frame": scene.frame.name, "to_source": scene.frame.to_source.tolist()}),
        **place_figures(scene.frame),
    }


def cost_figures(monitor: Monitor) -> dict[str, Any]:
    """Returns time by stage, peak memory and device."""
    seconds = {name: round(value, 3) for name, value in monitor.seconds.items()}
    return {"seconds": seconds, "peak_memory_mib": round(monitor.peak_memory_mib), "device": str(monitor.device)}


@contextmanager
def map_folder(folder: Path, output: str) -> Iterator[AddView]:
    """Writes one kind of map of every view into a folder, which appears once it is complete.

    Args:
        folder: output folder; the maps go into a subfolder named after the kind.
        output: a name in :data:`vg2gt.outputs.output_names.MAPS`.

    Yields:
        A function that writes a view's map.

    Raises:
        ValueError: if a view's name leads out of the folder or occurs twice.
    """
    kind, suffix = os.path.splitext(output)
    with whole_folder(folder / kind) as staged:

        def add(view: RenderedView) -> None:
            """Writes the map of one view."""
            name = portable(view_stem(view.camera.name))
            target = staged / f"{name}{suffix}"
            if not target.resolve().is_relative_to(staged.resolve()):
                raise ValueError(f"view name {view.camera.name!r} leads outside the output folder; rename it")
            if target.exists():
                raise ValueError(f"two views are called {name}; rename one of the cameras")
            target.parent.mkdir(parents=True, exist_ok=True)
            if kind == "color":
                write_png(target, view.color)
            else:
                np.save(target, (view.depth if kind == "depth" else view.normal).numpy())

        yield add


@contextmanager
def animation(path: Path, fps: float) -> Iterator[AddView]:
    """Writes the colour of the views as an animation, ``.gif`` or ``.mp4``, at ``fps`` frames per second.

    Raises:
        ImportError: if it is not a GIF and PyAV is not installed.
    """
    with video_writer(path, fps) as add:
        yield lambda view: add(to_pixels(view.color))


def feed(views: Iterable[RenderedView], sinks: Sequence[Sink], advance: Callable[[], None]) -> None:
    """Passes every view to every sink, then closes the sinks; on an error, no half-written folder remains."""
    with ExitStack() as stack:
        takers = [stack.enter_context(sink) for sink in sinks]
        for view in views:
            for add in takers:
                add(view)
            advance()


@contextmanager
def _mesh_fusion(scene: Scene, paths: Sequence[Path], voxel_size: float | None) -> Iterator[AddView]:
    """Collects the rendered depth and colour of the views, fuses them into a mesh and writes it to the paths.

    Rendered surfaces that no view has measured are left out. The mesh of an object is closed.

    Raises:
        ValueError: if no view has rendered depth.
    """
    kept: list[tuple[Tensor, Tensor]] = []
    yield lambda view: kept.append((view.depth, view.color))
    depth, colors = (torch.stack(maps) for maps in zip(*kept, strict=True))
    if not (depth > 0).any():
        raise ValueError("cannot create a mesh: no view has rendered depth; remove mesh from the outputs (--save)")
    median = float(depth[depth > 0].median())
    empty = depth == 0
    depth = torch.where(depth < _MESH_DEPTHS * median, depth, 0)
    if scene.support is not None:
        points = unproject(depth[None], scene.cameras.to("cpu"))[0]
        status = [point_support(view.flatten(0, 1), scene.depth, scene.cameras.to("cpu"))[0] for view in points]
        depth = torch.where(torch.stack(status).view_as(depth) >= Status.SINGLE, depth, 0)
    focal = float(scene.cameras.intrinsics[..., [0, 1], [0, 1]].mean())
    voxel_size = voxel_size or _MESH_PIXELS * median / focal
    if scene.is_object:
        means = scene.gaussians.means.detach().cpu()
        bounds = (means.amin(0), means.amax(0))
        mesh = fuse_solid(depth, empty, scene.cameras, colors, bounds, voxel_size)
    else:
        mesh = fuse_depth(depth, scene.cameras, colors, voxel_size=voxel_size)
    for path in paths:
        write_mesh(path, mesh)


def _report_png(scene: Scene, path: Path) -> None:
    """Writes one image with a row per view, for at most 12 evenly spread views."""
    shown = spread(len(scene.names), min(len(scene.names), ROWS))
    visible = scene.depth[scene.depth > 0]
    visible = visible[:: max(1, len(visible) // 1_000_000)]
    near, far = torch.quantile(visible, torch.tensor([0.02, 0.98])).tolist()
    cameras, rows = scene.named_cameras(), []
    for number, view in zip(shown, scene.render([cameras[number] for number in shown]), strict=True):
        depth, normals = colorize_depth(view.depth, near, far), colorize_normals(view.normal)
        rows.append([scene.images[number], view.color, depth, normals])
        if scene.support is not None:
            error = None if scene.error is None else scene.error[number]
            rows[-1].append(trust_picture(error, scene.support[number]))
    write_png(path, grid(rows))


def _views(scene: Scene, path: Path) -> None:
    """Writes the arrays of the views.

    ``names [V]`` are those of the views; ``images [V, H, W, 3]`` is uint8; ``depth``, ``depth_conf`` and, if known,
    ``mask`` and ``error`` are float32 ``[V, H, W]``; ``support [V, H, W]``, if known, is uint8.
    """
    images = np.stack([to_pixels(image) for image in scene.images])
    maps = {name: getattr(scene, name) for name in ("depth", "depth_conf", "mask", "error", "support")}
    arrays = {name: values.numpy() for name, values in maps.items() if values is not None}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, names=np.array(scene.names), images=images, **arrays)  # pyright: ignore[reportArgumentType]
    write_bytes(path, buffer.getvalue())


def _colmap(scene: Scene, target: Path) -> None:
    exported, points = exported_views(scene), scene.points()
    seen = exported.observations(scene)
    model = colmap_from_views(exported.cameras, exported.names, points.positions, points.colors, seen, exported.sizes)
    with whole_folder(target) as folder:
        exported.write_images(scene, folder / "images")
        write_colmap(folder / "sparse" / "0", model)


def _nerfstudio(scene: Scene, target: Path) -> None:
    exported = exported_views(scene)
    poses, intrinsics = exported.cameras.world_to_camera[0].numpy(), exported.cameras.intrinsics[0].numpy()
    frames = [
        TransformsFrame(f"images/{name}", pose, Lens.from_intrinsics(k, size))
        for name, pose, k, size in zip(exported.names, poses, intrinsics, exported.sizes, strict=True)
    ]
    with whole_folder(target) as folder:
        exported.write_images(scene, folder / "images")
        _points_ply(scene, folder / "points.ply")
        write_transforms(folder / "transforms.json", Transforms(tuple(frames), ply_file_path="points.ply"))


def _tiles(scene: Scene, target: Path) -> None:
    with whole_folder(target) as folder:
        write_tiles(folder, scene.gaussians)


def _scene_ply(scene: Scene, path: Path) -> None:
    """Writes the Gaussians with ``support`` and ``error``, as far as known."""
    known = {name: values.numpy() for name, values in (scene.gaussian_trust or {}).items()}
    write_gaussian_ply(path, scene.gaussians, extra=known)


def _page(scene: Scene, path: Path) -> None:
    pictures = [thumbnail(to_pixels(image)) for image in scene.images]
    cameras, options = scene.named_cameras(), scene.renderer
    shown = ViewerScene(
        scene.gaussians, cameras, pictures, scene_title(path), near=options.near, antialiased=options.antialiased
    )
    write_viewer_html(path, shown)


def _points_ply(scene: Scene, path: Path) -> None:
    points = scene.points()
    write_point_ply(path, points.positions, points.colors)


def _target(output: str) -> str:
    """Returns the file or folder name of an output."""
    return os.path.splitext(output)[0] if output in MAPS else output


_WRITERS: dict[str, Callable[[Scene, Path], Any]] = {
    "scene.ply": _scene_ply,
    "scene.spz": lambda scene, path: write_spz(path, scene.gaussians, scene.renderer.antialiased),
    "scene.glb": lambda scene, path: write_gaussian_gltf(path, scene.gaussians),
    "scene.gltf": lambda scene, path: write_gaussian_gltf(path, scene.gaussians),
    "scene.spz.glb": lambda scene, path: write_gaussian_gltf(path, scene.gaussians, True, scene.renderer.antialiased),
    "scene.html": _page,
    "tiles": _tiles,
    "cameras.json": lambda scene, path: write_cameras_json(path, scene.named_cameras()),
    "points.ply": _points_ply,
    "views.npz": _views,
    "report.png": _report_png,
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
}
