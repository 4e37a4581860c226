"""Finding, reading and strict loading of published weights. Never unpickles code."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from backends.base import seeded_initialisation
from vg2gt.io.tensors import read_tensors

_WEIGHT_FILE = "model.safetensors"
_SHOWN = 500  # characters of torch's message, which lists every tensor

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
        path: local file, or folder with ``model.safetensors``, instead of the repository.
        seed: seed of random weights.
        prefix: prefix of the keys in the file, before the network's own names.
        ignorable: prefixes of keys that may be in the file but not in the network.
        entry: key of the tensors in a file of ``torch.save`` that also holds an optimiser or the like.
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
    entry: str | None = None

    def build(self, make: Callable[[], Network]) -> Network:
        """Builds a network with these weights.

        Raises:
            FileNotFoundError: if the weights cannot be found.
            ImportError: if they must be downloaded and ``huggingface_hub`` is not installed.
            ValueError: if they do not fit, or ``path`` is given without ``pretrained``.
        """
        if not self.pretrained:
            if self.path is not None:
                conflict = f"pretrained=false requests random weights, but path={self.path} is set"
                raise ValueError(f"backend {self.name}: {conflict}; remove one of them")
            with seeded_initialisation(self.seed):
                return make()
        file = self.find()
        with torch.device("meta"):
            network = make()
        load_strictly(network, read_tensors(file, self.entry), self.prefix, self.ignorable, str(file))
        print(f"{self.name}: weights from {self.path or self.repo}, licence: {self.licence}")
        return network

    def find(self) -> Path:
        """Returns the weight file: ``path`` if given, else from the Hugging Face Hub or its local cache.

        Raises:
            FileNotFoundError: if it cannot be found or downloaded.
            ImportError: if the Hub is needed and ``huggingface_hub`` is not installed.
        """
        name, repo = self.name, self.repo
        remedy = f"give backend.path=FILE_OR_FOLDER, or backend.pretrained=false for random ones (repository: {repo})"
        if self.path is not None:
            given = Path(self.path).expanduser()
            file = given / _WEIGHT_FILE if given.is_dir() else given
            if not file.is_file():
                raise FileNotFoundError(f"no weights for backend {name} at {file}: {remedy}")
            return file
        if repo is None:
            raise FileNotFoundError(f"backend {name} has no published weights: {remedy}")
        try:
            from huggingface_hub import hf_hub_download  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            needed = f"backend {name} loads {_WEIGHT_FILE} from {repo} with huggingface_hub"
            raise ImportError(f"{needed}: pip install 'vg2gt[hub]', or {remedy}") from error
        print(f"{name}: looking for {repo} on the hub or in its cache", file=sys.stderr)
        logging.getLogger("huggingface_hub").setLevel(logging.ERROR)  # logs several lines per attempt
        try:
            return Path(hf_hub_download(repo, _WEIGHT_FILE, revision=self.revision))
        except Exception as error:  # raises its own errors and those of requests and httpx
            wanted = f"{_WEIGHT_FILE} of {repo} (revision {self.revision or 'newest'}) for backend {name}"
            reason = " ".join(str(error).split()).rstrip(".")
            check = f"Check the network and the revision, or {remedy}"
            raise FileNotFoundError(f"cannot get {wanted}: {reason}. {check}") from error


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
        ValueError: if tensors are missing, misshapen, unexpected or not finite, naming them.
    """
    wanted = network.state_dict()
    found = {key: value for key, value in state.items() if not key.startswith(tuple(ignorable))}
    found |= {prefix + name: state[prefix + name] for name in wanted if prefix + name in state}
    wrong = [key for key, value in found.items() if not (value.is_meta or torch.isfinite(value).all())]
    try:
        if wrong:
            raise RuntimeError(f"{wrong[0]} is not finite")
        network.load_state_dict({key.removeprefix(prefix): value.float() for key, value in found.items()}, assign=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{source} does not fit {type(network).__name__}: {reason[:_SHOWN]}") from error
