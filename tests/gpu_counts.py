"""Counts what a step asks of a GPU, on a CPU: kernels, and waits of the host for a value from the device.

Counts of waits are lower bounds: operations that wait twice internally count once (except ``bincount``), and copies to
the device are not counted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import vg2gt

WAITING = {
    "_local_scalar_dense": 1,  # item, bool, int, float
    "nonzero": 1,
    "masked_select": 1,
    "unique_consecutive": 1,
    "_unique2": 1,
    "unique_dim": 1,
    "bincount": 2,  # minimum and maximum
}
PACKAGE = Path(vg2gt.__file__).parent
# What differs from one kernel per operation: nothing runs, or a fill and a copy.
KERNELS = {
    **dict.fromkeys(("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"), 0),
    **dict.fromkeys(("_unsafe_view", "promote_types", "_local_scalar_dense"), 0),
    **dict.fromkeys(("_record_function_enter_new", "_record_function_exit"), 0),
    **dict.fromkeys(("constant_pad_nd", "slice_backward", "select_backward"), 2),
}
TENSORS = 30  # that a multi-tensor kernel takes at least


class Waits(TorchDispatchMode):
    """Counts waits inside its block, by the innermost calling function, such as ``method/grid.py plan_voxels``."""

    def __init__(self) -> None:
        super().__init__()
        self.places: Counter[str] = Counter()
        self._reading = False

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
            self.places[place(sys._getframe(2))] += waits


def _waits(name: str, args: Any, kwargs: Any) -> int:
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        masks = sum(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])
        # writing a single value at a mask needs no list of indices
        return 0 if name != "index" and args[2].numel() == 1 else masks
    if name == "repeat_interleave":  # the length of the result
        return int(kwargs.get("output_size") is None)
    if name == "segment_reduce":  # checks of the lengths
        return 2 * (not kwargs.get("unsafe"))
    return WAITING.get(name, 0)


def place(frame: FrameType | None) -> str:
    """The innermost function of the package in the call stack of a frame."""
    while frame is not None:
        file = Path(frame.f_code.co_filename)
        if file.is_relative_to(PACKAGE):  # not by name: an environment may lie in a checkout that is called so
            name = getattr(frame.f_code, "co_qualname", frame.f_code.co_name)  # Python 3.10 has no co_qualname
            return f"{file.relative_to(PACKAGE).as_posix()} {name.replace('.<locals>', '')}"
        frame = frame.f_back
    return "elsewhere"


class Operations(TorchDispatchMode):
    """Counts kernels of torch operations inside its block, except where ``muted()``, by calling function.

    An operation counts as one, but for views and :data:`KERNELS`; those over lists of tensors as one per
    :data:`TENSORS`. Counts are lower bounds: sorting, for one, takes several.
    """

    def __init__(self, muted: Callable[[], bool] = lambda: False) -> None:
        super().__init__()
        self.places: Counter[str] = Counter()
        self.muted = muted

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not func.is_view and not self.muted():
            name = func.overloadpacket.__name__
            several = name.startswith(("_foreach", "_fused"))
            count = -(-len(args[0]) // TENSORS) if several else KERNELS.get(name, 1)
            self.places[place(sys._getframe(1))] += count
        return func(*args, **(kwargs or {}))


@contextmanager
def as_on_a_gpu() -> Iterator[None]:
    """Makes a CPU run the code paths of a GPU inside the block, except Triton kernels."""
    from vg2gt.kernels import knn
    from vg2gt.losses import gaussian, geometry, strided
    from vg2gt.method import fine, sparse_conv
    from vg2gt.method.additions import voxel_normals

    changes: list[tuple[Any, str, Any]] = [
        (module, "compilable", lambda *_, **__: False) for module in (knn, fine, voxel_normals)
    ]
    changes += [
        (sparse_conv, "one_by_one", lambda device: False),
        (strided, "by_slices", lambda device: False),
        (geometry, "point_normal_loss", geometry.point_normal_reference),
        (geometry, "order_statistic", geometry.sorted_order_statistic),
        (gaussian, "structure_loss", gaussian.structure_reference),
    ]
    with ExitStack() as stack:
        for target, name, value in changes:
            stack.enter_context(mock.patch.object(target, name, value))
        yield


RENDER = Counter({"the renderer's operations and kernels": 33})


def count_step(step: Callable[[], Any]) -> tuple[Counter[str], Counter[str]]:
    """Kernels and waits of a training step on a GPU; the renderer counts as ``RENDER`` and one wait."""
    from vg2gt.method import serialization
    from vg2gt.profiling import listening

    quiet = [0]
    hilbert = serialization.hilbert_codes
    codes: Counter[str] = Counter()

    @contextmanager
    def rendering(name: str) -> Iterator[None]:
        quiet[0] += name == "render"
        yield
        quiet[0] -= name == "render"

    def in_one_kernel(*args: Any) -> Tensor:
        codes["Hilbert codes"] += 1
        with rendering("render"):
            return hilbert(*args)

    operations, waits = Operations(lambda: quiet[0] > 0), Waits()
    with as_on_a_gpu(), mock.patch.object(serialization, "hilbert_codes", in_one_kernel), listening(rendering):
        step()  # warm-up, as some checks run in the first step only
        codes.clear()
        with operations:
            step()
        found = operations.places + codes + RENDER
        with waits:
            step()
    # Shuffled orders are drawn on the CPU, without a wait.
    asked = {
        where: n for where, n in waits.places.items() if not where.startswith(("rendering/", "types.py Gaussians"))
    }
    asked.pop("method/ptv3.py Level.__post_init__", None)
    return found, Counter({**asked, "rendering/gpu_tiles.py _list": 1})
