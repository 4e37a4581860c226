"""Memory: caps on what a scene may have, and what to change when the memory was not enough."""

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
    "fewer images (--max-images, --every), smaller ones (--size), fewer voxels (model.fine.max_voxels=500000), "
    "fewer Gaussians (model.gaussians.max_gaussians=1000000) or smaller chunks (backend.head_chunk=2, "
    "model.fine.dense_head.views_per_chunk=2)"
)

# Parts of the messages of torch's allocators and of CUDA's, where the error has no class of its own.
# The last is what oneDNN says on some processors when it finds no memory for a convolution's scratch.
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
    """The device's memory is full; the message says with what sizes, and what to change."""


@contextmanager
def memory_advice(advice: str) -> Iterator[None]:
    """Turns what Python, torch or CUDA say when memory is full into one error; also a decorator.

    Args:
        advice: names the options that the caller's user has: :data:`TRAINING`, :data:`EVALUATION` or
            :data:`RECONSTRUCTION`.

    Raises:
        OutOfMemory: with the sizes that were noted inside (:func:`note_sizes`) and the advice.
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
        raise OutOfMemory(f"memory is full with {at_hand} ({said}). Take {advice}") from error
    finally:
        _sizes.reset(token)


def note_sizes(sizes: Mapping[str, int], first: bool = False) -> None:
    """Notes how many of what a pass has, for the message should it fail; ``first`` forgets those of the pass before."""
    noted = None if torch.compiler.is_compiling() else _sizes.get()
    if noted is None:
        return
    if first:
        noted.clear()
    noted.update(sizes)


def _is_full(error: Exception) -> bool:
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or any(part in str(error) for part in _SAID)


class Cap:
    """The most of something that each scene may have: what ranks lowest is dropped, counted and logged.

    The warning comes in the first pass that drops something, then in the second, fourth, eighth, ... of them.

    Args:
        option: the configuration's name of the limit, for the log.
        what: what is dropped, for the log and the metric.
        rank: how the dropped ones are called, such as ``least confident``.

    Attributes:
        dropped: how many the last pass dropped, over all of its scenes.
    """

    def __init__(self, option: str, what: str, rank: str) -> None:
        self.option = option
        self.what = what
        self.rank = rank
        self.dropped = 0
        self._passes = 0

    def __call__(self, limit: int | None, ranks: Tensor, batch: Tensor) -> Tensor | None:
        """Which of ``[M]`` to keep (None: all): the ``limit`` highest of every scene of ``batch [M]``, sorted."""
        self.dropped = 0
        if limit is None or len(batch) <= limit:
            return None
        keep = _highest(ranks.detach(), batch, limit)
        self.dropped = int((~keep).sum())
        if not self.dropped:
            return None
        self._passes += 1
        if self._passes & (self._passes - 1) == 0:
            log.warning(
                "%s=%d per scene: dropped the %d %s of %d %s (pass %d with losses; next said in pass %d)",
                self.option, limit, self.dropped, self.rank, len(batch), self.what, self._passes, 2 * self._passes,
            )  # fmt: skip
        return keep


def check_limit(option: str, limit: int | None) -> int | None:
    """Returns the limit; ValueError if it is below 1."""
    if limit is not None and limit < 1:
        raise ValueError(f"{option} must be at least 1, or null for no limit, got {limit}")
    return limit


def dropped_by(model: nn.Module) -> dict[str, int]:
    """What the limits of a model's parts dropped in its last pass, by what it was; only parts that have a limit."""
    found: dict[str, int] = {}
    for module in model.modules():
        cap = getattr(module, "cap", None)
        if isinstance(cap, Cap) and getattr(module, f"max_{cap.what.lower()}") is not None:
            found[cap.what.lower()] = cap.dropped
    return found


def _highest(ranks: Tensor, batch: Tensor, limit: int) -> Tensor:
    """``[M]`` bool: the ``limit`` highest of every scene."""
    keep = torch.ones_like(batch, dtype=torch.bool)
    begin = 0
    for count in torch.bincount(batch).tolist():
        if count > limit:
            lowest = ranks[begin : begin + count].argsort(stable=True)[: count - limit]
            keep[begin + lowest] = False
        begin += count
    return keep
