"""Finding, reading and strictly loading published weights. Nothing is ever unpickled."""

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
    """Where the weights of a network come from.

    Attributes:
        name: backend name for messages.
        licence: of the weights; printed when they are loaded.
        pretrained: whether to load published weights, or make seeded random ones.
        repo: Hugging Face repository.
        revision: its branch, tag or commit; None for the newest.
        path: a local file, or a folder with ``model.safetensors`` or ``model.pt``, instead of the repository.
        seed: of random weights.
        prefix: what the keys in the file begin with, before the network's own names.
        ignorable: beginnings of keys that the file may have and the network does not need.
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
            ValueError: if they do not fit.
        """
        if not self.pretrained:
            if self.path is not None:
                raise ValueError(
                    f"backend {self.name}: pretrained=false means random weights, path={self.path} names others: leave "
                    "one of them out"
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
    """The weight file: ``path`` if given, else from the hub's cache or the hub.

    Raises:
        FileNotFoundError: naming the file, the repository and the way out.
        ImportError: if the hub is needed and ``huggingface_hub`` is not installed.
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
        with _quiet("huggingface_hub"):  # every attempt would be told in several lines
            return Path(hf_hub_download(repo, WEIGHT_FILES[0], revision=revision))
    except Exception as error:  # the hub raises its own, requests' and httpx's errors
        raise FileNotFoundError(
            f"cannot get {WEIGHT_FILES[0]} of {repo} (revision {revision or 'newest'}) for backend {name}: "
            f"{_reason(error)}. Check the network, the revision and the cache, or {remedy}"
        ) from error


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Leaves out a package's warnings: what is wrong is in the error."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _reason(error: BaseException) -> str:
    """What the hub's client says, in one line; of a file not in the cache, also why it could not be fetched."""
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
    """Loads ``state`` into ``network``: every tensor must fit, and only ignorable ones may be left over.

    Args:
        network: takes the tensors themselves, so it may be on the meta device.
        state: tensors by name.
        prefix: what the names in ``state`` begin with, before the network's own.
        ignorable: beginnings of names in ``state`` that may be left over.
        source: for messages.

    Raises:
        ValueError: naming the first tensors that are missing, misshapen, unexpected or not finite.
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
