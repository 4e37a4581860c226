"""Graph breaks of the networks under ``torch.compile``: ``python benchmarks/compile_breaks.py``.

Traces each module at small sizes, with the inputs that a reconstruction gives it, and lists how many graphs it takes
and what parts them. Breaks are a matter of the code, not of the device. Writes a dated JSON file.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, write_results
from torch import Tensor, nn

from backends.dpt import DPT
from vg2gt.evaluation.tables import print_table
from vg2gt.method import DenseHead, GaussianHead, PointMLP, PTv3
from vg2gt.method.ptv3 import make_levels
from vg2gt.method.serialization import ORDERS, relative_grid, serial_keys
from vg2gt.types import Tokens, Voxels

PATCHES, PATCH, WIDTH, TAPS = (4, 8), 14, 32, 4
COUNTS = (90, 60)  # voxels of two scenes


@dataclass(frozen=True)
class Case:
    """A module and the arguments that a reconstruction gives it."""

    module: nn.Module
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Breaks:
    """What tracing found.

    Attributes:
        name: of the module.
        graphs: that it was traced into.
        reasons: what parts them and where, one for each break.
    """

    name: str
    graphs: int
    reasons: tuple[str, ...]


def cases() -> dict[str, Callable[[], Case]]:
    """Every network by name; made when called."""
    return {
        "dense head": _dense_head,
        "depth head (DPT)": _depth_head,
        "PTv3 block": _ptv3_block,
        "PTv3": lambda: Case(_ptv3(), (torch.randn(sum(COUNTS), WIDTH), *_voxels(), torch.ones(len(COUNTS)))),
        "PointMLP stage": _pointmlp_stage,
        "PointMLP": lambda: Case(_pointmlp(), (torch.randn(sum(COUNTS), WIDTH), *_voxels(), torch.ones(len(COUNTS)))),
        "Gaussian head": _gaussian_head,
    }


def _voxels() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    cells = torch.cat([torch.randperm(512, generator=generator)[:count].sort().values for count in COUNTS])
    grid = torch.stack((cells // 64, cells // 8 % 8, cells % 8), -1)
    return grid, torch.arange(len(COUNTS)).repeat_interleave(torch.tensor(COUNTS))


def _ptv3() -> PTv3:
    widths = {"enc_channels": (16, 32), "enc_depths": (1, 1), "enc_heads": (2, 4), "dec_channels": (16,)}
    return PTv3(WIDTH, **widths, dec_depths=(1,), dec_heads=(2,), window=16, stem_kernel=3, drop_path=0)


def _pointmlp() -> PointMLP:
    return PointMLP(WIDTH, channels=16, window=8)


def _ptv3_block() -> Case:
    grid, batch = _voxels()
    local = relative_grid(grid, batch, len(COUNTS))
    keys = serial_keys(local, batch, torch.ones(len(COUNTS)), ORDERS)
    (level,) = make_levels(local, batch, len(COUNTS), keys, (8, 8, 8), [[3]], None)
    block = _ptv3().get_submodule("enc.enc0.block0")
    features = torch.randn(sum(COUNTS), 16)
    block(features, level)  # lists windows and neighbours, whose numbers depend on the data
    return Case(block, (features, level))


def _pointmlp_stage() -> Case:
    network = _pointmlp()
    grid, batch = _voxels()
    local = relative_grid(grid, batch, len(COUNTS))
    windows = network._windows(local, batch, torch.ones(len(COUNTS)))
    return Case(network.stages[0], (torch.randn(sum(COUNTS), 16), local.float(), windows[0]))


def _dense_head() -> Case:
    rows, columns = PATCHES
    size = (rows * PATCH, columns * PATCH)
    taps = tuple(torch.randn(1, 2, rows * columns, WIDTH) for _ in range(TAPS))
    head = DenseHead([WIDTH] * TAPS, PATCH, features=16, out_channels=16)
    return Case(head, (Tokens(taps, torch.zeros(1, 2, 8), PATCHES, size), torch.rand(1, 2, 3, *size)))


def _depth_head() -> Case:
    rows, columns = PATCHES
    head = DPT(WIDTH, 16, (8, 8, 16, 16), 2, PATCH)
    return Case(head, ([torch.randn(2, rows * columns, WIDTH) for _ in range(TAPS)], PATCHES))


def _gaussian_head() -> Case:
    grid, batch = _voxels()
    count = sum(COUNTS)
    voxels = Voxels(
        torch.randn(count, WIDTH), torch.rand(count, 3), grid, batch, torch.ones(count), torch.ones(count),
        grid.float() + 0.5, torch.ones(len(COUNTS)), None,
    )  # fmt: skip
    return Case(GaussianHead(WIDTH), (voxels,))


def explain(name: str, case: Case) -> Breaks:
    """Traces a module in inference."""
    torch._dynamo.reset()
    with torch.no_grad():
        found = torch._dynamo.explain(case.module.eval())(*case.arguments)
    return Breaks(name, found.graph_count, tuple(_place(each) for each in found.break_reasons))


def _place(reason: Any) -> str:
    """Where a graph ends, and the first words on why."""
    frame = reason.user_stack[-1]
    return f"{Path(frame.filename).name} {frame.name}: {str(reason.reason).splitlines()[0]}"


def main() -> None:
    """Traces, prints and writes."""
    arguments = parser(__doc__).parse_args()
    logging.getLogger("torch._dynamo").setLevel(logging.ERROR)
    torch.manual_seed(0)
    found = [explain(name, make()) for name, make in cases().items()]
    rows = [[each.name, str(each.graphs), str(len(each.reasons)), "; ".join(each.reasons) or "-"] for each in found]
    print_table(["module", "graphs", "breaks", "why"], rows, text_columns=1, width=160)
    content = {"machine": machine(), "modules": [asdict(each) for each in found]}
    write_results(arguments.out, "compile-breaks", content)


if __name__ == "__main__":
    main()
