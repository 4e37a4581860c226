"""A training's kernels are compiled before it begins, in processes of their own.

The compiler needs some 200 MB that a process does not give back. What needs neither the model nor the data is compiled
while the command still imports Lightning, which takes seconds on one core; the rest when the run stands.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from types import FunctionType

import numba
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from vg2gt.data.synthetic import SyntheticScenes
from vg2gt.io.compiled import compiled_mark
from vg2gt.profiling import listening
from vg2gt.rendering import Renderer
from vg2gt.rendering.selfcheck import as_scene, fixed_scene

log = logging.getLogger(__name__)

LARGE_FRAME = (1 << 16) + 64  # values of 8 bytes; a little more than a power of two leaves the other half of a chunk
PATIENCE = 300  # seconds; a step of a large backbone on a slow machine takes longer than compiling
BEGINS = "compiling kernels, once on this machine and version (about 10 s)"
SYNTHETIC = "vg2gt.data.SyntheticScenes"  # the only source of scenes with kernels of its own


@dataclass(frozen=True)
class Compiling:
    """Processes that compile.

    Attributes:
        rooms: what rooms are made with; None where none are trained on.
        rendering: the renderer.
    """

    rooms: BaseProcess | None
    rendering: BaseProcess


def begin_compiling(config: DictConfig) -> Compiling | None:
    """Begins to compile what the rooms and the renderer of a training on a CPU need, in processes beside this one.

    Args:
        config: of the training.

    Returns:
        The processes, for :func:`compile_kernels`; None where all was compiled before or it cannot be done.
    """
    trainer = config.trainer
    on_gpu = trainer.accelerator not in ("cpu", "auto") or (trainer.accelerator == "auto" and torch.cuda.is_available())
    if on_gpu or trainer.get("fast_dev_run") or str(trainer.devices) != "1" or not _to_compile():
        return None
    log.info(BEGINS)
    _start_compiler()
    synthetic = config.data.get("train", {}).get("_target_") == SYNTHETIC
    rooms = _forked(_make_rooms, config.data.variant) if synthetic else None
    return Compiling(rooms, _forked(_render, config.renderer))


def compile_kernels(
    renderer: Renderer,
    prepare_step: Callable[[], Callable[[], torch.Tensor]],
    begun: Compiling | None = None,
    meanwhile: Iterator[object] | None = None,
) -> None:
    """Compiles what training on a CPU needs, once a machine and version; what fails here is compiled when it is used.

    Nothing is done where a process cannot be forked safely (other systems than Linux, other threads).

    Args:
        renderer: the run's.
        prepare_step: loads what a training step needs and returns the step up to its loss, which is taken in another
            process, whose changes are lost.
        begun: what :func:`begin_compiling` began.
        meanwhile: work for one thread of this process, a piece at a time, until the others have ended.
    """
    if begun is None:
        if not _to_compile():
            return
        log.info(BEGINS)
        _start_compiler()
        begun = Compiling(None, _forked(_render, renderer))
    if begun.rooms is not None:
        begun.rooms.join(PATIENCE)
    pieces = meanwhile or iter(())
    with _one_thread():
        rest = _forked(_step, prepare_step(), begun.rendering.sentinel)
        end = time.monotonic() + PATIENCE
        while rest.is_alive() and time.monotonic() < end and next(pieces, None) is not None:
            pass
    for process in (begun.rendering, rest):
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
    mark = compiled_mark()
    with suppress(OSError):
        if mark is not None:
            mark.mkdir(parents=True, exist_ok=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _start_compiler() -> None:
    """Makes numba load what compiling and running kernels needs: here and not in every process again."""
    numba.njit(_nothing)()


def _nothing() -> None:
    """Compiled in a blink."""


def _to_compile() -> bool:
    """Whether this was not done yet, and a process can be forked safely."""
    mark = compiled_mark()
    return sys.platform == "linux" and threading.active_count() == 1 and mark is not None and not mark.is_dir()


def _forked(work: Callable[..., None], *arguments: object) -> BaseProcess:
    process = multiprocessing.get_context("fork").Process(target=_quietly, args=(work, *arguments), daemon=True)
    process.start()
    return process


def _quietly(work: Callable[..., None], *arguments: object) -> None:
    """Works without a word and on one thread: those of OpenMP do not survive a fork.

    No garbage is collected in a process that ends so soon; every page that the collector touched would be copied.
    """
    gc.disable()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    logging.disable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    _in_one_chunk(work, arguments)


def _call(work: Callable[..., None], arguments: Sequence[object]) -> None:
    work(*arguments)


_in_one_chunk = FunctionType(_call.__code__.replace(co_stacksize=LARGE_FRAME), globals())
"""Calls a function with room for all its calls' frames in one piece of memory.

CPython (since 3.11) takes memory for frames in chunks of 16 kB from the operating system, and gives one back when calls
leave it: a compiler that goes to and fro across the end of a chunk spent a third of its time in the kernel. A function
with a large frame is given a chunk of up to twice its size, and the frames of what it calls lie in the rest.
"""


def _make_rooms(variant: str | Sequence[str]) -> None:
    """Makes a small picture of the first scenes."""
    source = SyntheticScenes(4, num_frames=1, size=(16, 16), variant=variant)
    for scene in source.scenes:
        source.load(scene, [0])


def _render(renderer: Renderer | DictConfig) -> None:
    """Renders a small scene, with and without gradients."""
    render: Renderer = instantiate(renderer) if isinstance(renderer, DictConfig) else renderer
    inputs = [tensor.float() for tensor in fixed_scene()]
    with torch.no_grad():
        render(*as_scene(inputs), mode="solid")
    gaussians, cameras = as_scene([*(tensor.requires_grad_() for tensor in inputs[:5]), *inputs[5:]])
    out = render(gaussians, cameras)
    (out.color.sum() + out.depth.sum() + out.normal.sum() + out.alpha.sum()).backward()


def _step(step: Callable[[], torch.Tensor], rendering: int) -> None:
    """Takes a step, which renders when the other process has ended."""

    @contextmanager
    def wait(name: str) -> Iterator[None]:
        if name == "render":
            connection.wait([rendering])
        yield

    with listening(wait):
        step().backward()
