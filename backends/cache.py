"""Disk cache of a frozen backbone's outputs."""

from __future__ import annotations

import hashlib
import io
import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.io.files import write_cached
from vg2gt.io.tensors import tensors_digest
from vg2gt.types import Cameras, Geometry, Hints, Tokens

log = logging.getLogger(__name__)

Found = TypeVar("Found")

_RECORDS = [Tokens, Geometry, Cameras]  # classes that a file may hold besides tensors and plain values


class TokenCache:
    """Caches exact tokens and decoded geometry per set of views, or only their cameras.

    The key is a hash of the images and hints, the backend's identity (its weights), options and source code, the device
    type and the torch version. Several processes may share the folder.

    Args:
        folder: folder of the files, created when needed; ``~`` is the home folder.
        max_gb: maximum size of the folder in GB; least recently used files are removed first.

    Raises:
        ValueError: if the size is not positive.
    """

    def __init__(self, folder: str | os.PathLike[str], max_gb: float = 8.0) -> None:
        if max_gb <= 0:
            raise ValueError(f"token_cache.max_gb must be positive, got {max_gb}")
        self.folder = Path(folder).expanduser()
        self.max_bytes = int(max_gb * 1e9)

    @torch.no_grad()
    def read(self, backend: Backend, images: Tensor, hints: Hints | None) -> tuple[Tokens, Geometry]:
        """Returns the tokens of ``images`` and their decoded geometry, from the cache or from the backend."""

        def make() -> tuple[Tokens, Geometry]:
            tokens = backend.encode(images, hints)
            return tokens, backend.decode(tokens)

        return self._kept(cache_key(backend, images, hints), images.device, make)

    def cameras(self, backend: Backend, images: Tensor, hints: Hints | None) -> Cameras:
        """Returns only the raw cameras of ``images``, from the cache or from the backend."""
        key = f"{cache_key(backend, images, hints)}-cameras"
        return self._kept(key, images.device, lambda: backend.predict_cameras(images, hints))

    def _kept(self, key: str, device: torch.device, make: Callable[[], Found]) -> Found:
        path = self.folder / f"{key}.pt"
        try:
            with torch.serialization.safe_globals(_RECORDS):
                found = torch.load(path, map_location=device, weights_only=True)
            with suppress(OSError):  # read-only folder
                os.utime(path)
            return found
        except FileNotFoundError:
            pass
        except Exception as error:  # damaged files fail in many ways; all are fixed by writing the file again
            log.warning("cannot read %s (%s): computing it again", path, error)
        found, buffer = make(), io.BytesIO()
        torch.save(found, buffer)
        write_cached(path, buffer.getvalue(), self.folder)
        self._remove_oldest()
        return found

    def _remove_oldest(self) -> None:
        with suppress(OSError):  # another process removes files as well, and does so after its next one
            kept = sorted((file.stat().st_mtime, file.stat().st_size, file) for file in self.folder.glob("*.pt"))
            excess = sum(size for _, size, _ in kept) - self.max_bytes
            for _, size, file in kept[:-1]:
                if excess > 0:
                    file.unlink(missing_ok=True)
                excess -= size


def cache_key(backend: Backend, images: Tensor, hints: Hints | None) -> str:
    """Returns a hash of everything that determines the backend's output for these views."""
    source = _source(frozenset(base.__module__ for base in type(backend).__mro__))
    made_by = [backend.identity(), _options(backend), source, images.device.type, torch.__version__]
    tensors = {"images": images}
    if hints is not None:
        made_by.append(hints.scene_key)
        hints.map(lambda tensor: tensors.setdefault(f"hint {len(tensors)}", tensor))
    return hashlib.sha256(repr((*made_by, tensors_digest(tensors))).encode()).hexdigest()[:40]


def _options(backend: Backend) -> list[tuple[str, str, object]]:
    """Plain attributes of the backend and all its submodules, such as those of nested backends."""
    plain = (bool, int, float, str, tuple, type(None))
    return [
        (path, name, value)
        for path, module in backend.named_modules()
        for name, value in sorted(vars(module).items())
        if name != "training" and not name.startswith("_") and isinstance(value, plain)
    ]


@lru_cache
def _source(modules: frozenset[str]) -> str:
    """Hash of the source of this package and of the given modules, which may be a user's own."""
    named = {getattr(sys.modules.get(module), "__file__", None) for module in modules}
    files = {*Path(__file__).parent.rglob("*.py"), *(Path(path) for path in named if path)}
    digest = hashlib.sha256()
    for path in sorted(files):
        with suppress(OSError):  # classes defined in a notebook have no file
            digest.update(path.read_bytes())
    return digest.hexdigest()
