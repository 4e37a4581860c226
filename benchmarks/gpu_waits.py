"""Where the host would wait for a GPU, without one: ``python benchmarks/gpu_waits.py [--views N] [overrides]``.

A wait is a value of the device that the host needs to go on: a number, or a shape that depends on data. Runs a
reconstruction and a training step of whatever model the overrides name on the CPU and counts, by the function that
asked, the torch operations that wait on CUDA. At least so often: an operation that waits twice inside (``bincount``
apart) counts once, and the backbone's network is not looked into. Prints tables and writes a dated JSON file.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

WAITING = {
    "_local_scalar_dense": 1,  # item, bool, int, float
    "nonzero": 1,
    "masked_select": 1,
    "unique_consecutive": 1,
    "_unique2": 1,
    "unique_dim": 1,
    "bincount": 2,  # the smallest and the largest value
}
PACKAGE = "vg2gt"


class Waits(TorchDispatchMode):
    """Counts what waits inside its block.

    Attributes:
        places: how often, by the innermost function of the package that asked, such as ``method/grid.py plan_voxels``.
    """

    def __init__(self) -> None:
        super().__init__()
        self.places: Counter[str] = Counter()
        self._reading = False

    @property
    def total(self) -> int:
        """All of them."""
        return self.places.total()

    def __enter__(self) -> Waits:
        read = Tensor.tolist

        def tolist(tensor: Tensor) -> Any:
            self._count(1)
            self._reading = True
            try:
                return read(tensor)
            finally:
                self._reading = False

        self._patch = mock.patch.object(Tensor, "tolist", tolist)
        self._patch.start()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._patch.stop()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not self._reading:
            self._count(_waits(func.overloadpacket.__name__, args, kwargs or {}))
        return func(*args, **(kwargs or {}))

    def _count(self, waits: int) -> None:
        if waits:
            self.places[_place(sys._getframe(2))] += waits


def _waits(name: str, args: Any, kwargs: Any) -> int:
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        masks = sum(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])
        # one value where a mask is true needs no list of places
        return 0 if name != "index" and args[2].numel() == 1 else masks
    if name == "repeat_interleave":  # the length of the result
        return int(kwargs.get("output_size") is None)
    if name == "segment_reduce":  # whether the lengths are good
        return 2 * (not kwargs.get("unsafe"))
    return WAITING.get(name, 0)


def _place(frame: FrameType | None) -> str:
    while frame is not None:
        parts = Path(frame.f_code.co_filename).parts
        if PACKAGE in parts:
            within = len(parts) - parts[::-1].index(PACKAGE)
            name = getattr(frame.f_code, "co_qualname", frame.f_code.co_name)  # Python 3.10 knows the last part only
            return f"{'/'.join(parts[within:])} {name.replace('.<locals>', '')}"
        frame = frame.f_back
    return "elsewhere"


def main() -> None:
    """Counts, prints and writes."""
    from common import parser, training_step, write_results
    from stages import Case, prepare

    from vg2gt.evaluation.tables import print_table
    from vg2gt.method.additions import point_moments, voxel_normals

    voxel_normals.compilable = point_moments.compilable = lambda *_: False  # as on a GPU
    options = parser(__doc__, overrides="Hydra overrides, such as model=vg2gt")
    options.add_argument("--views", type=int, default=4)
    options.add_argument("--size", type=int, nargs=2, default=[112, 224])
    arguments = options.parse_args()
    case = Case(arguments.views, tuple(arguments.size), tuple(arguments.overrides))
    with tempfile.TemporaryDirectory() as folder:
        run, batch = prepare(case, torch.device("cpu"), folder)
        context, model = batch.context, run.module.model
        found: dict[str, Counter[str]] = {}
        with torch.no_grad(), Waits() as waits:
            model.eval()(context.images, context.hints)
        found["reconstruction"] = waits.places
        step = training_step(run)
        with Waits() as waits:
            loss = step(batch)
        found["training step, forward"] = waits.places
        with Waits() as waits:
            loss.backward()
        found["training step, backward"] = waits.places
    for name, places in found.items():
        rows = [[place, str(count)] for place, count in places.most_common()]
        print_table(["place", "waits"], [*rows, ["all", str(places.total())]], title=name, text_columns=1, width=120)
    counts = {name: {"all": places.total(), "places": dict(places.most_common())} for name, places in found.items()}
    write_results(arguments.out, "gpu-waits", {"overrides": arguments.overrides, "views": arguments.views, **counts})


if __name__ == "__main__":
    main()
