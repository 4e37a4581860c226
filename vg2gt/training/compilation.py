"""A training's kernels are compiled before it begins, in processes of their own.

The compiler needs some 200 MB that a process does not give back, and two processes compile side by side.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection

import torch

from vg2gt.io.compiled import compiled_mark
from vg2gt.profiling import listening
from vg2gt.rendering import Renderer
from vg2gt.rendering.selfcheck import as_scene, fixed_scene

log = logging.getLogger(__name__)

PATIENCE = 300  # seconds; a step of a large backbone on a slow machine takes longer than compiling


def compile_kernels(renderer: Renderer, step: Callable[[], torch.Tensor]) -> None:
    """Compiles what training on a CPU needs, once a machine and version; what fails here is compiled when it is used.

    Nothing is done where a process cannot be forked safely (other systems than Linux, other threads).

    Args:
        renderer: the run's.
        step: takes a training step up to its loss; called in another process, whose changes are lost.
    """
    mark = compiled_mark()
    if sys.platform != "linux" or threading.active_count() > 1 or mark is None or mark.is_dir():
        return
    log.info("compiling kernels, once on this machine and version (about 10 s)")
    forked = multiprocessing.get_context("fork")
    rendering = forked.Process(target=_quietly, args=(_render, renderer))
    rendering.start()
    rest = forked.Process(target=_quietly, args=(_step, step, rendering.sentinel))
    rest.start()
    for process in (rendering, rest):
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
    with suppress(OSError):
        mark.mkdir(parents=True, exist_ok=True)


def _quietly(work: Callable[..., None], *arguments: object) -> None:
    """Works without a word and on one thread: those of OpenMP do not survive a fork."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    logging.disable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    work(*arguments)


def _render(renderer: Renderer) -> None:
    """Renders a small scene, with and without gradients."""
    inputs = [tensor.float() for tensor in fixed_scene()]
    with torch.no_grad():
        renderer(*as_scene(inputs), mode="solid")
    gaussians, cameras = as_scene([*(tensor.requires_grad_() for tensor in inputs[:5]), *inputs[5:]])
    out = renderer(gaussians, cameras)
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
