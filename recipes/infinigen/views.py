"""Renders views of a room: colour, depth, normals and cameras, in Infinigen's layout.

``make.py`` runs this script in Infinigen's environment: ``views.py scene.blend OUT --seed 7 --kind LivingRoom``. To
resume after an interruption, run the same command again; finished views are kept.

Colour is path traced with a few samples and denoised. Depth and normals come from a second pass with one ray through
the centre of every pixel, as Blender's depth in the first pass is that of a random point in or next to the pixel. Clear
window panes are transparent; beyond them is sky, whose depth is infinite.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import time
from pathlib import Path
from typing import Any

_cores = os.sched_getaffinity(0)
os.sched_setaffinity(0, {min(_cores)})  # Blender reads the number of cores once, on import
import bpy  # noqa: E402

os.sched_setaffinity(0, _cores)
import numpy as np  # noqa: E402
from make import KINDS  # noqa: E402
from mathutils import Matrix, Vector  # noqa: E402
from paths import View, plan  # noqa: E402
from PIL import Image  # noqa: E402

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV camera axes to Blender's
_SKY = 1e4  # metres; Blender's depth of the sky is 1e10
_THINGS = (0.08, 1.3)  # minimum and maximum radius of objects to look at, in metres
_FIXED = ("Window", "Door", "CeilingLight", "Skirting", "Curtain", "Rug", "Ceiling", "Wall", "Pillar")
_SAMPLES = 8  # per pixel of the colour pass
_GRAY = 0.22  # target of the exposure: mean linear brightness


class Room:
    """Room of the open Blender file, as ``paths.plan`` needs it.

    Args:
        kind: Infinigen's name of the kind of room; if there are several, the one with most objects is used.

    Raises:
        SystemExit: if there is no such room.
    """

    def __init__(self, kind: str) -> None:
        _show_what_is_rendered()
        self._scene = bpy.context.scene
        self._graph = bpy.context.evaluated_depsgraph_get()
        meshes = [item for item in bpy.data.objects if item.type == "MESH" and item.visible_get()]
        floors = [item for item in meshes if item.name.startswith(KINDS[kind]) and ".floor" in item.name]
        if not floors:
            raise SystemExit(f"the scene has no floor of a {kind}")
        things = [_thing(item) for item in meshes if "Factory" in item.name and not any(x in item.name for x in _FIXED)]
        spheres = np.array([thing for thing in things if _THINGS[0] < thing[3] < _THINGS[1]]).reshape(-1, 4)
        inside = {floor.name: np.array([self._is_above(floor, x[:3]) for x in spheres], bool) for floor in floors}
        self._floor = max(floors, key=lambda floor: inside[floor.name].sum())
        self.objects = spheres[inside[self._floor.name]]
        corners = _corners(self._floor)
        self.low, self.high = corners.min(0), corners.max(0)
        self.low[2] = self.high[2]  # top of the floor, which may be thick
        middle = Vector((*((self.low + self.high)[:2] / 2), self.low[2] + 0.1))
        ceilings = [item for item in meshes if item.name == self._floor.name.replace(".floor", ".ceiling")]
        self.high[2] = _corners(ceilings[0])[:, 2].min() if ceilings else middle.z + 2.5

    def _is_above(self, floor: Any, point: np.ndarray) -> bool:
        to_floor = floor.matrix_world.inverted()
        start, down = to_floor @ Vector(point), to_floor.to_3x3() @ Vector((0, 0, -1))
        return bool(floor.ray_cast(start, down.normalized(), distance=10.0)[0])

    def inside(self, point: np.ndarray) -> bool:
        """Returns whether a point is above the room's own floor."""
        return self._is_above(self._floor, point)

    def cast(self, origin: np.ndarray, direction: np.ndarray) -> tuple[float, bool]:
        """Returns the distance to the first surface along a unit direction (inf: none), and whether its back is hit."""
        ray = Vector(direction)
        hit, place, normal, *_ = self._scene.ray_cast(self._graph, Vector(origin), ray)
        return ((place - Vector(origin)).length, normal.dot(ray) > 0) if hit else (math.inf, False)


def _corners(item: Any) -> np.ndarray:
    return np.array([item.matrix_world @ Vector(corner) for corner in item.bound_box])


def _thing(item: Any) -> np.ndarray:
    """Centre and radius of the sphere around an object's bounding box."""
    corners = _corners(item)
    low, high = corners.min(0), corners.max(0)
    return np.array([*(low + high) / 2, np.linalg.norm(high - low) / 2])


def _show_what_is_rendered() -> None:
    """Shows in the viewport exactly what is rendered, as ray casts hit viewport objects."""
    for item in bpy.data.objects:
        item.hide_viewport = item.hide_render
    for collection in bpy.data.collections:
        collection.hide_viewport = collection.hide_render
    bpy.context.view_layer.update()


class Renderer:
    """Renders views in two passes: colour, then depth and normals.

    Args:
        size: image ``(height, width)``.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        scene = self._scene = bpy.context.scene
        self._folder = Path(tempfile.mkdtemp())
        camera = bpy.data.objects.new("view", bpy.data.cameras.new("view"))
        scene.collection.objects.link(camera)
        scene.camera = self._camera = camera
        camera.data.clip_start, camera.data.sensor_fit = 0.02, "HORIZONTAL"
        render, cycles = scene.render, scene.cycles
        render.engine, cycles.device = "CYCLES", "CPU"
        render.threads_mode, render.threads = "FIXED", 1
        render.use_persistent_data = True
        render.resolution_percentage = 100
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0
        render.use_motion_blur, cycles.use_adaptive_sampling = False, False
        cycles.time_limit, cycles.denoiser, cycles.film_exposure = 0, "OPENIMAGEDENOISE", 1.0
        layer = bpy.context.view_layer
        layer.use_pass_z = layer.use_pass_normal = True
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        layers, self._files = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeOutputFile")
        self._files.base_path = str(self._folder)
        self._files.format.file_format, self._files.format.color_depth = "OPEN_EXR", "32"
        self._files.file_slots[0].path = "depth"
        self._files.file_slots.new("normal")
        tree.links.new(layers.outputs["Depth"], self._files.inputs[0])
        tree.links.new(layers.outputs["Normal"], self._files.inputs[1])
        composite = tree.nodes.new("CompositorNodeComposite")
        tree.links.new(layers.outputs["Image"], composite.inputs[0])

    def _place(self, view: View, exposure: float) -> None:
        self._camera.matrix_world = Matrix((view.camera_to_world() @ _FLIP).tolist())
        self._camera.data.angle_x = view.field_of_view
        self._scene.view_settings.exposure = exposure

    def _render(self, path: Path, size: tuple[int, int], samples: int, kind: str) -> None:
        scene, image = self._scene, self._scene.render.image_settings
        scene.render.resolution_y, scene.render.resolution_x = size
        scene.cycles.samples, scene.cycles.use_denoising = samples, samples > 1
        scene.cycles.max_bounces = 6 if samples > 1 else 0
        # A very narrow filter sends the only ray through the centre of the pixel.
        scene.cycles.pixel_filter_type, scene.cycles.filter_width = (
            ("BLACKMAN_HARRIS", 1.5) if samples > 1 else ("BOX", 0.01)
        )
        self._files.mute = samples > 1
        image.file_format = kind
        if kind == "JPEG":
            image.quality = 92
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)

    def exposure(self, views: list[View], drawn: float) -> float:
        """Returns the exposure of a path in stops: measured on small renderings of two views, plus ``drawn``."""
        path, levels = self._folder / "probe.exr", []
        for view in (views[0], views[len(views) // 2]):
            self._place(view, 0.0)
            self._render(path, (self.size[0] // 4, self.size[1] // 4), 4, "OPEN_EXR")
            levels.append(np.minimum(_read(path), 4.0)[..., :3].mean())
        return float(np.clip(math.log2(_GRAY / max(float(np.mean(levels)), 1e-6)) + drawn, -6, 10))

    def color(self, view: View, exposure: float, path: Path) -> None:
        """Renders the colours and writes them as JPEG."""
        self._place(view, exposure)
        self._render(path, self.size, _SAMPLES, "JPEG")

    def geometry(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Renders z-depth ``[h, w]`` in metres and normals ``[h, w, 3]`` in OpenCV camera axes; sky is inf and 0."""
        self._place(view, 0.0)
        self._render(self._folder / "unused.exr", self.size, 1, "OPEN_EXR")
        number = f"{self._scene.frame_current:04d}.exr"
        depth = _read(self._folder / f"depth{number}")[..., 0]
        normal = _read(self._folder / f"normal{number}")[..., :3] @ view.camera_to_world()[:3, :3]
        sky = depth > _SKY
        return np.where(sky, np.inf, depth), np.where(sky[..., None], 0, normal)


def _read(path: Path) -> np.ndarray:
    """Pixels ``[h, w, 4]`` of an EXR file, top row first."""
    image = bpy.data.images.load(str(path), check_existing=False)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def _planned(out: Path, kind: str, seed: int, count: int) -> list[View]:
    """Reads the views of a room from ``views.json`` of an interrupted run, or draws and writes them."""
    path = out / "views.json"
    if path.exists():
        rows = json.loads(path.read_text())
        return [View(r["path"], np.array(r["position"]), np.array(r["forward"]), r["roll"], r["fov"]) for r in rows]
    views = plan(Room(kind), np.random.default_rng(seed), count)
    rows = [
        {"path": v.path, "position": v.position.tolist(), "forward": v.forward.tolist(), "roll": v.roll,
         "fov": v.field_of_view} for v in views
    ]  # fmt: skip
    new = path.with_name("views.json.new")
    new.write_text(json.dumps(rows))
    os.replace(new, path)
    return views


def _write_view(out: Path, index: int, view: View, renderer: Renderer, exposure: float) -> None:
    """Writes one view. The camera comes last, so that a view with a camera is complete."""
    stem = f"0_0_{index:04d}_0"
    places = {kind: out / "frames" / kind / "camera_0" for kind in ("Image", "Depth", "SurfaceNormal", "camview")}
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    renderer.color(view, exposure, places["Image"] / f"Image_{stem}.jpg")
    depth, normal = renderer.geometry(view)
    np.save(places["Depth"] / f"Depth_{stem}.npy", depth.astype(np.float16))
    levels = np.rint(127.5 * (np.clip(normal, -1, 1) + 1)).astype(np.uint8)
    Image.fromarray(levels).save(places["SurfaceNormal"] / f"SurfaceNormal_{stem}.png")
    height, width = renderer.size
    focal = width / 2 / math.tan(view.field_of_view / 2)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    new = out / "camera.new.npz"
    np.savez(new, K=intrinsics, T=view.camera_to_world(), HW=np.array(renderer.size))
    os.replace(new, places["camview"] / f"camview_{stem}.npz")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("blend", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--kind", choices=list(KINDS), required=True)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--size", type=int, nargs=2, default=(112, 224), metavar=("HEIGHT", "WIDTH"))
    args = parser.parse_args()
    started = time.process_time()
    bpy.ops.wm.open_mainfile(filepath=str(args.blend.resolve()))
    args.out.mkdir(parents=True, exist_ok=True)
    views = _planned(args.out, args.kind, args.seed, args.views)
    print(f"{len(views)} views planned after {time.process_time() - started:.0f} core seconds", flush=True)
    renderer = Renderer(tuple(args.size))
    cameras = args.out / "frames" / "camview" / "camera_0"
    for name in dict.fromkeys(view.path for view in views):
        path = [(i, view) for i, view in enumerate(views) if view.path == name]
        left = [(i, view) for i, view in path if not (cameras / f"camview_0_0_{i:04d}_0.npz").exists()]
        if not left:
            continue
        drawn = float(np.clip(np.random.default_rng((args.seed, path[0][0])).normal(0, 0.7), -2, 2))
        exposure = renderer.exposure([view for _, view in path], drawn)
        for i, view in left:
            begun = time.process_time()
            _write_view(args.out, i, view, renderer, exposure)
            print(f"view {i} ({view.path}): {time.process_time() - begun:.1f} core seconds", flush=True)


if __name__ == "__main__":
    main()
