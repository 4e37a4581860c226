"""Figure of solid and rasterised depth of a scene: ``python benchmarks/depth_figure.py [--out PICTURE]``.

Upper row: colour, rasterised depth, solid depth. Lower row: true depth, and the error of each (bright is large).
Colours agree, but rasterised depth jumps between Gaussians, whereas solid depth is continuous.
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import parser
from render_scene import room_cameras, room_gaussians, true_depth

from vg2gt.io.images import colorize_depth, grid, write_png
from vg2gt.rendering import render

SIZE = (224, 448)
ERROR_SHOWN = 0.03  # metres at full brightness


def main() -> None:
    """Renders, prints the errors and writes the picture."""
    options = parser(__doc__, out=Path("docs/figures/solid-against-rasterized.png"))
    options.add_argument("--gaussians", type=int, default=20_000)
    arguments = options.parse_args()
    gaussians = room_gaussians(arguments.gaussians, SIZE, sigma=(100_000 / arguments.gaussians) ** 0.5)
    cameras = room_cameras(3, SIZE).select(slice(1, 2))
    truth = true_depth(cameras)[0, 0]
    near, far = float(truth.min()), float(truth.max())
    upper, lower = [], [colorize_depth(truth, near, far)]
    for mode in ("rasterized", "solid"):
        out = render(gaussians, cameras, mode)
        depth = out.depth[0, 0]
        error = (depth - truth).abs()
        valid = depth > 0
        share, mean = float(valid.float().mean()), float(error[valid].mean())
        print(f"{mode}: mean depth error {1e3 * mean:.2f} mm, pixels with depth {share:.1%}")
        if not upper:
            upper.append(out.color[0, 0])
        upper.append(colorize_depth(depth, near, far))
        lower.append(torch.where(valid, error / ERROR_SHOWN, 0.0).clamp(max=1).expand(3, *SIZE))
    print(write_png(arguments.out, grid([upper, lower])))


if __name__ == "__main__":
    main()
