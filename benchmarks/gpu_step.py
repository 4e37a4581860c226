"""Counts what a rendering step asks of a GPU, without one: ``python benchmarks/gpu_step.py [--views 1 8 18]``.

Runs forward and backward passes of the Triton path on the CPU with its kernels replaced by recorders, and lists the
torch operations (allocations and all, views apart), the launches, the values that the host waits for, and the most
bytes that are held at once. Tile counts are those of the benchmark's room, computed by the reference projection. The
torch implementation is counted beside it, run for real with few Gaussians: its operations do not depend on them.
"""

from __future__ import annotations

import weakref
from collections import Counter
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from common import MEGABYTE, parser, write_results
from gpu_kernels import recorded
from gpu_waits import Waits
from render_scene import room_cameras, room_gaussians
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from vg2gt.evaluation.tables import print_table
from vg2gt.kernels.render_gpu.tiles import TILE
from vg2gt.rendering import Renderer
from vg2gt.rendering.options import RenderOptions, SceneViews
from vg2gt.rendering.projection import Splats, pixel_boxes, project, screen_box
from vg2gt.types import Cameras, Gaussians

SIZE = (224, 448)
ALLOCATIONS = ("empty", "new_empty", "empty_like")
SORT_SCRATCH = 24  # bytes an entry that CUB's pair sort takes beside keys and order: indices, and a copy of both


@dataclass
class Count:
    """What one step took.

    Attributes:
        implementation: ``torch`` or ``triton``.
        gaussians: number of Gaussians.
        views: of 224 x 448 pixels.
        entries: (tile, Gaussian) pairs of all views; 0 where there are none.
        operations: torch operations of both passes, views of tensors apart.
        kernels: Triton launches of both passes.
        waits: values that the host waits for.
        megabytes: held at once at most, beside the inputs.
    """

    implementation: str
    gaussians: int
    views: int
    entries: int = 0
    operations: int = 0
    kernels: int = 0
    waits: int = 0
    megabytes: float = 0.0

    @property
    def total(self) -> int:
        """Operations and launches."""
        return self.operations + self.kernels


class Watch(TorchDispatchMode):
    """Counts operations and follows the bytes of all storages that they make."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        self.held, self.most = 0, 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.names[func.overloadpacket.__name__] += 1
            scratch = SORT_SCRATCH * args[0].numel() if func.overloadpacket.__name__ == "sort" else 0
            for tensor in result if isinstance(result, (tuple, list)) else (result,):
                if isinstance(tensor, Tensor):
                    self.follow(tensor.untyped_storage())
            self.most = max(self.most, self.held + scratch)
        return result

    def follow(self, storage: Any) -> None:
        """Adds a storage until it is freed."""
        key, size = storage._cdata, storage.nbytes()
        if key in self.known:
            return
        self.known.add(key)
        self.held += size
        weakref.finalize(storage, self.forget, key, size)

    def forget(self, key: int, size: int) -> None:
        """A storage was freed."""
        self.known.discard(key)
        self.held -= size


def seen_by(gaussians: Gaussians, cameras: Cameras, view: int) -> tuple[Splats, Tensor, Tensor, Tensor]:
    """One view's splats, first and last pixel ``[G, 2]`` of each, and ``[G]`` whether it has any pixel."""
    options, one = RenderOptions(), slice(view, view + 1)
    scene = SceneViews(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[None, :, 0],
        cameras.world_to_camera[0, one], cameras.intrinsics[0, one], torch.zeros(3), cameras.size,
    )  # fmt: skip
    pose, splats = cameras.world_to_camera[0, view], project(scene, options)
    box, bounded = screen_box(splats)
    first, last = pixel_boxes(torch.nan_to_num(box), cameras.size)
    in_front = gaussians.means @ pose[2, :3] + pose[2, 3] > options.near
    return splats, first, last, bounded & in_front & (last >= first).all(-1)


def tile_counts(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Tiles ``[V, G]`` that each Gaussian covers in each view, by the reference projection."""
    rows = []
    for view in range(cameras.world_to_camera.shape[1]):
        _, first, last, seen = seen_by(gaussians, cameras, view)
        rows.append(torch.where(seen, (last // TILE - first // TILE + 1).prod(-1), 0))
    return torch.stack(rows)


def count_step(implementation: str, count: int, views: int) -> Count:
    """Counts a forward and a backward pass with gradients of colour, depth and normals."""
    gaussians, cameras = room_gaussians(count, SIZE), room_cameras(views, SIZE)
    tiles = tile_counts(gaussians, cameras) if implementation == "triton" else torch.zeros(1)
    gaussians = gaussians.map(lambda t: t.requires_grad_() if t.is_floating_point() else t)
    renderer = Renderer(implementation=implementation)  # type: ignore[arg-type]
    watch, waits = Watch(), Waits()
    stubs = {"project_kernel": lambda counts, **_: counts.view(-1).copy_(tiles.view(-1))}
    with recorded(stubs) as launches:
        with waits, watch:
            out = renderer(gaussians, cameras)
            outputs = [out.color, out.depth, out.normal]
        weights = [torch.ones_like(image) for image in outputs]
        with waits, watch:
            torch.autograd.backward(outputs, weights)
    inside = len(launches) and 1  # the recorder's own copy of the counts
    return Count(
        implementation,
        count,
        views,
        int(tiles.sum()),
        sum(watch.names.values()) - inside,
        len(launches),
        waits.total,
        watch.most / MEGABYTE,
    )


def main() -> None:
    """Counts, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--gaussians", type=int, default=100_000)
    options.add_argument("--views", type=int, nargs="+", default=[1, 8, 18])
    arguments = options.parse_args()
    rows = [count_step("triton", arguments.gaussians, views) for views in arguments.views]
    rows += [replace(count_step("torch", 200, views), megabytes=float("nan")) for views in arguments.views[:2]]
    head = ["implementation", "Gaussians", "views", "entries", "operations", "kernels", "waits", "MB"]
    shown = [[*map(str, list(asdict(row).values())[:-1]), f"{row.megabytes:.0f}"] for row in rows]
    print_table(head, shown, title="a step: forward and backward", text_columns=1, width=120)
    counts = [{**asdict(row), "megabytes": None if row.megabytes != row.megabytes else row.megabytes} for row in rows]
    write_results(arguments.out, "gpu-step", {"size": SIZE, "steps": counts})


if __name__ == "__main__":
    main()
