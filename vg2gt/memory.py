"""Limits on the number of elements per scene, and advice when memory runs out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor, nn

log = logging.getLogger(__name__)

TRAINING = (
    "fewer images per step (data.max_images, training.render_views), smaller ones (data.image_size), fewer voxels "
    "(model.fine.max_voxels, or a larger model.fine.voxel_size) or fewer Gaussians (model.gaussians.max_gaussians)"
)
EVALUATION = (
    "fewer images (views), smaller ones (data.image_size), fewer voxels (+model.fine.max_voxels=500000, or a larger "
    "+model.fine.voxel_size), fewer Gaussians (+model.gaussians.max_gaussians=1000000) or smaller chunks "
    "(+backend.head_chunk=2, +model.fine.dense_head.views_per_chunk=2)"
)
RECONSTRUCTION = (
    "fewer images (--max-images), smaller ones (--size), fewer voxels (model.fine.max_voxels=500000), "
    "fewer Gaussians (model.gaussians.max_gaussians=1000000), smaller chunks "
    "(+model.fine.dense_head.views_per_chunk=2, of VGGT and DA3 also backend.head_chunk=2), or refine smaller "
    "photographs (refine.full.size=800, --quality draft)"
)

# Parts of out-of-memory messages of torch's allocators and of CUDA that have no exception class of their own.
# The last is oneDNN's on some processors when it cannot allocate the scratch space of a convolution.
_SAID = (
    "allocate memory",
    "not enough memory",
    "out of memory",
    "bad_alloc",
    "ALLOC_FAILED",
    "could not create a primitive",
)

_sizes: ContextVar[dict[str, int] | None] = ContextVar("sizes", default=None)


class OutOfMemory(MemoryError):
    """The device's memory is full; the message names the sizes in use and what to change."""


@contextmanager
def memory_advice(advice: str) -> Iterator[None]:
    """Converts out-of-memory errors of Python, torch and CUDA into :class:`OutOfMemory`; also a decorator.

    Args:
        advice: the options that reduce memory in the caller's command: :data:`TRAINING`, :data:`EVALUATION` or
            :data:`RECONSTRUCTION`.

    Raises:
        OutOfMemory: with the sizes recorded inside the block (:func:`note_sizes`) and the advice.
    """
    sizes: dict[str, int] = {}
    token = _sizes.set(sizes)
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, OutOfMemory) or not _is_full(error):
            raise
        at_hand = ", ".join(f"{count} {what}" for what, count in sizes.items()) or "nothing loaded yet"
        said = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise OutOfMemory(f"out of memory with {at_hand} ({said}). To reduce memory, use {advice}") from error
    finally:
        _sizes.reset(token)


def note_sizes(sizes: Mapping[str, int], first: bool = False) -> None:
    """Records element counts of a pass for the error message; ``first`` clears those of the previous pass."""
    noted = _sizes.get()
    if noted is None:
        return
    if first:
        noted.clear()
    noted.update(sizes)


def _is_full(error: Exception) -> bool:
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or any(part in str(error) for part in _SAID)


class Cap:
    """Limits the number of elements per scene: the lowest-ranked ones are dropped, counted and logged.

    The warning is logged in the first, second, fourth, eighth, ... pass that drops elements.

    Args:
        option: configuration key of the limit, for the log.
        limit: largest number of elements per scene; None keeps all.
        what: name of the elements, for the log and the metric.
        rank: name of the lowest rank, such as ``least confident``, for the log.

    Raises:
        ValueError: if the limit is below 1.

    Attributes:
        limit: as given.
        dropped: number of elements dropped in the last pass, over all scenes.
    """

    def __init__(self, option: str, limit: int | None, what: str, rank: str) -> None:
        if limit is not None and limit < 1:
            raise ValueError(f"{option} must be at least 1, or null for no limit, got {limit}")
        self.option = option
        self.limit = limit
        self.what = what
        self.rank = rank
        self.dropped = 0
        self._passes = 0

    def __call__(self, ranks: Tensor, batch: Tensor) -> Tensor | None:
        """Returns a ``[M]`` mask of the highest ranks per scene (None: keep all); ``batch [M]`` is sorted."""
        self.dropped = 0
        if self.limit is None or len(batch) <= self.limit:
            return None
        keep = torch.ones_like(batch, dtype=torch.bool)
        begin = 0
        for count in torch.bincount(batch).tolist():
            lowest = ranks.detach()[begin : begin + count].argsort(stable=True)[: max(count - self.limit, 0)]
            keep[begin + lowest] = False
            begin += count
        self.dropped = int((~keep).sum())
        if not self.dropped:
            return None
        self._passes += 1
        if self._passes & (self._passes - 1) == 0:
            log.warning(
                "%s=%d per scene: dropped the %d %s of %d %s (passes that dropped some: %d; next warning at %d)",
                self.option, self.limit, self.dropped, self.rank, len(batch), self.what, self._passes, 2 * self._passes,
            )  # fmt: skip
        return keep


def dropped_by(model: nn.Module) -> dict[str, int]:
    """Returns how many elements a model dropped in its last pass, by name; only for parts with a limit."""
    caps = [cap for module in model.modules() if isinstance(cap := getattr(module, "cap", None), Cap)]
    return {cap.what.lower(): cap.dropped for cap in caps if cap.limit is not None}
