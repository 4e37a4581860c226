"""Finding, reading and strict loading of published weights. Never unpickles code."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from backends.base import seeded_initialisation
from vg2gt.io.tensors import read_tensors

WEIGHT_FILES = ("model.safetensors", "model.pt")
SHOWN = 5

Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class Weights:
    """Source of a network's weights.

    Attributes:
        name: backend name for messages.
        licence: licence of the weights, printed when they are loaded.
        pretrained: whether to load published weights, otherwise seeded random ones.
        repo: Hugging Face repository.
        revision: branch, tag or commit of the repository; None for the newest.
        path: local file, or folder with ``model.safetensors`` or ``model.pt``, instead of the repository.
        seed: seed of random weights.
        prefix: prefix of the keys in the file, before the network's own names.
        ignorable: prefixes of keys that may be in the file but not in the network.
    """

    name: str
    licence: str
    pretrained: bool
    repo: str | None
    revision: str | None
    path: str | None
    seed: int
    prefix: str = ""
    ignorable: tuple[str, ...] = ()

    def build(self, make: Callable[[], Network]) -> Network:
        """Builds a network with these weights.

        Raises:
            FileNotFoundError: if the weights cannot be found.
            ImportError: if they must be downloaded and ``huggingface_hub`` is not installed.
            ValueError: if they do not fit, or ``path`` is given without ``pretrained``.
        """
        if not self.pretrained:
            if self.path is not None:
                raise ValueError(
                    f"backend {self.name}: pretrained=false requests random weights, but path={self.path} is set; "
                    "remove one of them"
                )
            with seeded_initialisation(self.seed):
                return make()
        file = find_weights(self.name, self.repo, self.revision, self.path)
        with torch.device("meta"):
            network = make()
        load_strictly(network, read_tensors(file), self.prefix, self.ignorable, str(file))
        print(f"{self.name}: weights from {self.path or self.repo}, licence: {self.licence}")
        return network


def find_weights(name: str, repo: str | None, revision: str | None, path: str | None) -> Path:
    """Returns the weight file: ``path`` if given, else from the Hugging Face Hub or its local cache.

    Raises:
        FileNotFoundError: if it cannot be found or downloaded.
        ImportError: if the Hub is needed and ``huggingface_hub`` is not installed.
    """
    remedy = f"give backend.path=FILE_OR_FOLDER, or backend.pretrained=false for random weights (repository: {repo})"
    if path is not None:
        given = Path(path).expanduser()
        candidates = [given / file for file in WEIGHT_FILES] if given.is_dir() else [given]
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        raise FileNotFoundError(f"no weights for backend {name} at {', '.join(map(str, candidates))}: {remedy}")
    if repo is None:
        raise FileNotFoundError(f"backend {name} has no published weights: {remedy}")
    try:
        from huggingface_hub import hf_hub_download  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            f"backend {name} loads {WEIGHT_FILES[0]} from {repo} with huggingface_hub, which is not installed: "
            f"pip install 'vg2gt[hub]', or {remedy}"
        ) from error
    print(f"{name}: looking for {repo} on the hub or in its cache", file=sys.stderr)
    try:
        with _quiet("huggingface_hub"):  # logs several lines per attempt
            return Path(hf_hub_download(repo, WEIGHT_FILES[0], revision=revision))
    except Exception as error:  # raises its own errors and those of requests and httpx
        raise FileNotFoundError(
            f"cannot get {WEIGHT_FILES[0]} of {repo} (revision {revision or 'newest'}) for backend {name}: "
            f"{_reason(error)}. Check the network, the revision and the cache, or {remedy}"
        ) from error


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Silences the warnings of a package, as the error says what is wrong."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _reason(error: BaseException) -> str:
    """The Hub client's message in one line; for a file not in the cache, also the reason why the download failed."""
    root = error
    while isinstance(error, FileNotFoundError) and root.__cause__ is not None:
        root = root.__cause__
    told = [error] if root is error else [error, root]
    return "; ".join(" ".join(str(one).split()).rstrip(".") for one in told)


def _has_bad_numbers(tensor: Tensor) -> bool:
    return not tensor.is_meta and not bool(torch.isfinite(tensor).all())


def load_strictly(
    network: nn.Module, state: Mapping[str, Tensor], prefix: str, ignorable: Sequence[str], source: str
) -> None:
    """Loads ``state`` into ``network``; every tensor must fit, and only ignorable ones may be left over.

    Args:
        network: network to load into. The tensors are assigned, so it may be on the meta device.
        state: tensors by name.
        prefix: prefix of the names in ``state``, before the network's own names.
        ignorable: prefixes of names in ``state`` that may be left over.
        source: name of the file, for messages.

    Raises:
        ValueError: if tensors are missing, misshapen, unexpected or not finite; names the first of them.
    """
    wanted = {prefix + key: value for key, value in network.state_dict().items()}
    complaints = [f"missing {key} {list(value.shape)}" for key, value in wanted.items() if key not in state]
    complaints += [
        f"{key} is {list(state[key].shape)}, expected {list(value.shape)}"
        for key, value in wanted.items()
        if key in state and state[key].shape != value.shape
    ]
    complaints += [f"unexpected {key}" for key in state if key not in wanted and not key.startswith(tuple(ignorable))]
    bad = next((key for key in wanted if key in state and _has_bad_numbers(state[key])), None)
    if bad is not None:
        complaints.insert(0, f"{bad} is not finite")
    if complaints:
        more = f"; and {len(complaints) - SHOWN} more" if len(complaints) > SHOWN else ""
        raise ValueError(f"{source} does not fit {type(network).__name__}: {'; '.join(complaints[:SHOWN])}{more}")
    loaded = {key.removeprefix(prefix): state[key].to(value.dtype) for key, value in wanted.items()}
    network.load_state_dict(loaded, assign=True)
