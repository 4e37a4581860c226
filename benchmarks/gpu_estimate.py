"""How long the Triton renderer should take on an H100, without one: ``python benchmarks/gpu_estimate.py``.

Counts for the benchmark's room how many entries (tile, Gaussian) there are, and for a sample of tiles how many the
kernels visit and how many of those a ray meets; multiplies by the instructions that a warp executes for either in the
loops compiled for sm_90. Bytes are those of the layouts. Prints milliseconds, writes a dated JSON file.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass

import torch
from common import parser, write_results
from gpu_kernels import assembly, variants
from gpu_step import seen_by
from render_scene import room_cameras, room_gaussians
from torch import Tensor

from vg2gt.evaluation.tables import print_table
from vg2gt.kernels.constants import ALPHA_MIN, MEDIAN_MAX_TRANSMITTANCE, TRANSMITTANCE_STOP
from vg2gt.kernels.render_gpu.tiles import TILE
from vg2gt.rendering.gpu_tiles import NEGLIGIBLE
from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.projection import respond
from vg2gt.types import Cameras, Gaussians

SOURCE = (224, 448)  # pixels of the views that the room's Gaussians are made of
CASES = ((100_000, 8, SOURCE), (1_000_000, 8, SOURCE), (100_000, 1, (1080, 1920)), (1_000_000, 1, (1080, 1920)))
SAMPLE = 32  # tiles a view
SIDES = (TILE, 16)  # pixels: our tiles and gsplat's
# An H100 SXM: multiprocessors, schedulers of each, hertz; bytes a second. Warps wait for memory half of the time.
ISSUED = 132 * 4 * 1.755e9 * 0.5
BANDWIDTH = 3.35e12
ENTRY_BYTES, SLOT_BYTES = 600, 250  # moved for an entry (sort, keys, lists, gradient row) and for a Gaussian in a view
KERNELS = ("blend solid=True geometry=True mean=False", "backward solid=True geometry=True mean=False")


@dataclass(frozen=True)
class Loop:
    """Instructions that a warp executes for an entry that a ray of the tile meets, and for one that none meets."""

    met: int
    missed: int


@dataclass(frozen=True)
class Visits:
    """What a tile's program goes through, in the mean over a sample of tiles.

    Attributes:
        entries: of the tile.
        blended: visited by the blending loop, and by the backward pass.
        blended_met: of those, met by a ray.
        solved: visited by each section and each Newton step of the median.
        solved_met: of those, met by a ray that has a median.
    """

    entries: float
    blended: float
    blended_met: float
    solved: float
    solved_met: float


def count_entries(gaussians: Gaussians, cameras: Cameras, sample: int) -> tuple[dict[int, int], Visits]:
    """Entries by the side of a tile, ours and gsplat's, and means over ``sample`` random tiles of every view."""
    height, width = cameras.size
    across, down = -(-width // TILE), -(-height // TILE)
    generator = torch.Generator().manual_seed(0)
    entries: dict[int, int] = dict.fromkeys(SIDES, 0)
    found = []
    for view in range(cameras.world_to_camera.shape[1]):
        splats, first, last, seen = seen_by(gaussians, cameras, view)
        for side in SIDES:
            entries[side] += int((last[seen] // side - first[seen] // side + 1).prod(-1).sum())
        for tile in torch.randint(across * down, (sample,), generator=generator).tolist():
            corner = torch.tensor([tile % across, tile // across]) * TILE
            near = (seen & (first < corner + TILE).all(-1) & (last >= corner).all(-1)).nonzero()[:, 0]
            near = near[splats.depth[near].argsort(stable=True)]
            x, y = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="xy")
            pixels = torch.stack((x, y), -1).view(-1, 2) + corner
            pixels = pixels[(pixels < torch.tensor([width, height])).all(-1)]
            found.append(_visits(*respond(splats[near], pixels[:, None].float())))
    return entries, Visits(*(sum(values) / len(values) for values in zip(*found, strict=True)))


def _visits(response: Tensor, peak: Tensor, precision: Tensor) -> tuple[int, int, int, int, int]:
    """What the kernels do in one tile, from the responses ``[rays, entries]`` of its entries, front to back."""
    count = response.shape[1]
    alpha = torch.where(response >= ALPHA_MIN, response.clamp(max=RenderOptions().alpha_max), 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), 1)
    alive = before >= TRANSMITTANCE_STOP
    met = (alpha > 0) & alive
    kept = met & (after >= TRANSMITTANCE_STOP)
    blended = int(alive.any(0).sum())
    # as far as the median can depend on an entry
    early = before > 0.25
    behind = torch.where(kept & early, peak, 0.0).cummax(1).values if count else peak
    matters = kept & (early | (precision * (peak - behind).clamp(min=0).square() <= NEGLIGIBLE[torch.float32]))
    final = torch.where(kept, 1 - alpha, 1.0).prod(1)
    solvable = final < MEDIAN_MAX_TRANSMITTANCE
    last = int(matters.any(0).nonzero()[-1, 0]) + 1 if bool(matters.any()) else 0
    last = min(last, int(alive[solvable].any(0).sum()))
    return count, blended, int(met.any(0).sum()), last, int(met[solvable, :last].any(0).sum())


def loops(text: str) -> list[Loop]:
    """The innermost loops of a kernel's machine code that load, in order."""
    places: dict[str, int] = {}
    code: list[str] = []
    for line in text.splitlines():
        if label := re.match(r"^(\.L_x_\d+):", line):
            places[label[1]] = len(code)
        elif instruction := re.match(r"^\s+/\*[0-9a-f]{4,}\*/\s+(.*?);", line):
            code.append(instruction[1])
    jumps = [
        (at, places[to[1]]) for at, line in enumerate(code) if (to := re.search(r"BRA\S*.*`\((\.L_x_\d+)\)", line))
    ]
    back = sorted((to, at) for at, to in jumps if to <= at)
    inner = [(a, b) for a, b in back if b - a > 40 and not any(a <= c and d <= b and (a, b) != (c, d) for c, d in back)]
    found = []
    for begin, end in inner:
        if not any("LDG" in line for line in code[begin:end]):
            continue  # code out of line that jumps back
        skipped = max((to - at - 1 for at, to in jumps if begin <= at < to <= end), default=0)
        found.append(Loop(end - begin + 1, end - begin + 1 - skipped))
    return found


def milliseconds(visits: Visits, tiles: int, found: dict[str, Loop]) -> dict[str, float]:
    """Time of the kernels that visit tiles."""
    options = RenderOptions()
    times = {"blend": 1, "section": -(-options.bisections // 3), "newton": options.newton_steps + 1, "backward": 1}
    result = {}
    for name, loop in found.items():
        solving = name in ("section", "newton")
        visited, met = (visits.solved, visits.solved_met) if solving else (visits.blended, visits.blended_met)
        issued = met * loop.met + (visited - met) * loop.missed
        result[name] = 1e3 * times[name] * tiles * issued / ISSUED
    return result


def main() -> None:
    """Estimates, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--sample", type=int, default=SAMPLE)
    arguments = options.parse_args()
    launches = variants()
    (blend, section, newton), (backward,) = (loops(assembly(launches[name], "sm_90")) for name in KERNELS)
    found = {"blend": blend, "section": section, "newton": newton, "backward": backward}
    print(found)
    rows, shown = [], []
    for count, views, (height, width) in CASES:
        gaussians, cameras = room_gaussians(count, SOURCE), room_cameras(views, (height, width))
        tiles = views * -(-height // TILE) * -(-width // TILE)
        by_side, visits = count_entries(gaussians, cameras, arguments.sample)
        times, entries = milliseconds(visits, tiles, found), by_side[TILE]
        times["memory"] = 1e3 * (entries * ENTRY_BYTES + count * views * SLOT_BYTES) / BANDWIDTH
        row = {"gaussians": count, "views": views, "size": (height, width), "entries_by_side": by_side}
        rows.append({**row, "visits": asdict(visits), "milliseconds": times})
        numbers = [visits.blended, visits.blended_met, visits.solved, visits.solved_met]
        shown.append(
            [f"{count} x {views} at {height}x{width}", str(entries), f"{visits.entries:.0f}"]
            + [f"{value:.0f}" for value in numbers]
            + [f"{value:.2f}" for value in (*times.values(), sum(times.values()))]
        )
    head = ["case", "entries", "a tile", "blended", "met", "solved", "met", *times, "all ms"]
    print_table(head, shown, text_columns=1, width=160)
    loops_found = {name: asdict(loop) for name, loop in found.items()}
    write_results(arguments.out, "gpu-estimate", {"loops": loops_found, "cases": rows})


if __name__ == "__main__":
    main()
