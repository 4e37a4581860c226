"""What a frozen backbone made of a set of views, kept on disk: frozen means computed once."""

from __future__ import annotations

import hashlib
import io
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.io.files import write_cached
from vg2gt.types import Cameras, Geometry, Hints, TensorRecord, Tokens

log = logging.getLogger(__name__)

Found = TypeVar("Found")

_RECORDS = [Tokens, Geometry, Cameras]  # all that a file may hold beside tensors and plain values


class TokenCache:
    """Keeps tokens and initially decoded geometry per set of views, exactly; of held-out views' sets the cameras alone.

    The key is a hash of the images and hints themselves, the backend's identity (its weights) and options, and torch's
    version, so whatever changes is computed anew. It pays where view sets come again (``data.view_sets``,
    evaluation before and after training) and the backbone costs more than reading a file.

    Args:
        folder: of the files, made when needed (``~`` is the home folder).
        max_gb: size that the folder may reach; the files used least recently go first.

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
        """Tokens of ``images`` and what they decode to, from the folder or from the backend."""

        def make() -> tuple[Tokens, Geometry]:
            tokens = backend.encode(images, hints)
            return tokens, backend.decode(tokens)

        return self._kept(cache_key(backend, images, hints), images.device, make)

    def cameras(self, backend: Backend, images: Tensor, hints: Hints | None) -> Cameras:
        """The raw cameras of ``images`` alone, from the folder or from the backend."""
        key = f"{cache_key(backend, images, hints)}-cameras"
        return self._kept(key, images.device, lambda: backend.predict_cameras(images, hints))

    def _kept(self, key: str, device: torch.device, make: Callable[[], Found]) -> Found:
        path = self.folder / f"{key}.pt"
        found = self._load(path, device)
        if found is None:
            found = make()
            self._store(path, found)
        return found

    def _load(self, path: Path, device: torch.device) -> Any:
        try:
            with torch.serialization.safe_globals(_RECORDS):
                found = torch.load(path, map_location=device, weights_only=True)
            os.utime(path)
        except FileNotFoundError:
            return None
        except Exception as error:  # damaged files fail in many ways; all of them are mended by writing it again
            log.warning("%s cannot be read (%s): made again", path, error)
            return None
        return found

    def _store(self, path: Path, found: object) -> None:
        buffer = io.BytesIO()
        torch.save(found, buffer)
        write_cached(path, buffer.getvalue(), self.folder)
        files = sorted(self.folder.glob("*.pt"), key=lambda file: file.stat().st_mtime)
        excess = sum(file.stat().st_size for file in files) - self.max_bytes
        for file in files[:-1]:
            if excess <= 0:
                break
            excess -= file.stat().st_size
            file.unlink(missing_ok=True)


def cache_key(backend: Backend, images: Tensor, hints: Hints | None) -> str:
    """Hash of everything that decides what the backend makes of these views."""
    identity = backend.identity()  # first: the backend keeps it
    plain = (bool, int, float, str, tuple, type(None))
    options = {name: value for name, value in sorted(vars(backend).items()) if isinstance(value, plain)}
    options.pop("training", None)
    digest = hashlib.sha256(repr((identity, options, torch.__version__)).encode())

    def add(tensor: Tensor) -> Tensor:
        digest.update(f"{tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return tensor

    add(images)
    if isinstance(hints, TensorRecord):
        digest.update(repr(hints.scene_key).encode())
        hints.map(add)
    return digest.hexdigest()[:40]
