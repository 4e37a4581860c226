"""What the synthetic generator makes: ``python benchmarks/synthetic_figure.py [--out PICTURE]``.

A room, the same room with highlights, two outdoor scenes, two objects and a landmark: two frames of the camera's path,
then depth (logarithmic, grey where there is none) and normals of the first.
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import parser
from torch import Tensor

from vg2gt.data.synthetic import SyntheticScenes
from vg2gt.io.images import colorize_depth, colorize_normals, grid, write_png

ROWS = (
    ("room", 2, False), ("room", 2, True), ("outdoor", 12, True), ("outdoor", 14, False),
    ("object", 1, False), ("object", 2, True), ("landmark", 0, False),
)  # fmt: skip
FRAMES = (9, 12)  # of 16


def panels(variant: str, seed: int, highlights: bool, size: tuple[int, int]) -> list[Tensor]:
    """One row of the picture."""
    source = SyntheticScenes(1, seed, 16, size, variant, highlights)
    (name,) = source.scenes
    frames = source.scene(name).render(FRAMES, torch.get_num_threads())
    colors = [torch.from_numpy(frame.image).permute(2, 0, 1) / 255 for frame in frames]
    depth = torch.from_numpy(frames[0].depth)
    near, far = float(depth[depth > 0].min().log()), float(depth.max().log())
    shown = torch.where(depth > 0, colorize_depth(1 + depth.clamp_min(1e-3).log() - near, 1, 1 + far - near), 0.5)
    return [*colors, shown, colorize_normals(torch.from_numpy(frames[0].normal).permute(2, 0, 1))]


def main() -> None:
    """Renders and writes the picture."""
    options = parser(__doc__, out=Path("docs/figures/synthetic.png"))
    options.add_argument("--size", type=int, nargs=2, default=(140, 280))
    arguments = options.parse_args()
    rows = [panels(*row, size=tuple(arguments.size)) for row in ROWS]
    print(write_png(arguments.out, grid(rows)))


if __name__ == "__main__":
    main()
