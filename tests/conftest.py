"""Fixtures used by every test folder.

What takes seconds to import is imported by the fixtures: the process that starts the others loads this file as well,
and they wait for it.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: there is a test process a core

import copy
import gc
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.sharing import made_once, shared_folder

# A full collection looks at all that was imported, 0.3 s long: a third as many as by default take 4 % less in all.
gc.set_threshold(700, 10, 100)

SHALLOW = ["+backend=da3_tiny", "+backend.depth=4", "+backend.multiview_from=1", "+backend.taps=[0,1,2,3]"]

SHARED = Path(__file__).resolve().parents[2] / "shared"
BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


# Tests that run commands in forks of a server process. It has imported everything, which takes ten seconds.
WARM = {"reliability", "studies", "test_log.py", "test_architecture.py", "test_plugins.py"}


@pytest.hookimpl(trylast=True)  # after others are deselected
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts tests of commands first and tests of the renderer in the middle, where the second worker starts.

    Only the first worker then starts the server, and the two workers do not compile the same kernels at the same time.
    """
    first = [item for item in items if WARM & {item.path.name, item.path.parent.name}]
    middle = [item for item in items if item.path.parent.name == "rendering"]
    middle.sort(key=lambda item: item.path.name != "test_triton.py")
    others = [item for item in items if item not in {*first, *middle}]
    before = max(len(items) // 2 - len(first), 0)
    items[:] = [*first, *others[:before], *middle, *others[before:]]


def pytest_collection_finish() -> None:
    """Leaves what was imported out of full collections."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """Lets the interpreter take it apart at its end."""
    gc.unfreeze()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """One process for the tests of a GPU, which others would take the memory of; otherwise one a core."""
    return 0 if config.option.markexpr == "gpu" else None


@pytest.fixture(scope="session", autouse=True)
def configurations_are_parsed_once() -> Iterator[None]:
    """Most tests compose a configuration; a third of that is to parse the same files."""
    from omegaconf import OmegaConf

    load, kept = OmegaConf.load, {}

    def once(file: Any) -> Any:
        path = getattr(file, "name", None) if hasattr(file, "read") else file
        if not isinstance(path, str | Path):
            return load(file)
        about = os.stat(path)
        key = (str(path), about.st_mtime_ns, about.st_size)
        if key not in kept:
            kept[key] = load(file)
        return copy.deepcopy(kept[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(once))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real samples and reference outputs next to the checkout; skips without it."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the reference data folder {SHARED.name}/ next to the checkout")
    return SHARED


@pytest.fixture
def benchmark_script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Imports a script of ``benchmarks/`` by its name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of rendered rooms, so that each is rendered once."""
    return shared_folder(tmp_path_factory, "rooms")


@pytest.fixture(scope="session")
def shallow_da3():
    """The network behind :func:`onnx_bundle`: da3_tiny with half its blocks, to export faster."""
    from hydra.utils import instantiate

    from vg2gt.config import compose

    return instantiate(compose(None, *SHALLOW).backend)


@pytest.fixture(scope="session")
def onnx_bundle(shallow_da3, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported network without ``decoder.onnx``, which this library does not run and takes as long to export."""
    import torch

    from backends import onnx

    def export_encoder(backend: onnx.Exportable, folder: Path) -> dict[str, float]:
        encoder = onnx.Graph(backend, onnx.encode_tensors).eval()
        tokens = onnx.token_names(len(backend.token_dims))
        with torch.no_grad():
            inputs = onnx.example_inputs(backend, *onnx.TRACED)
            onnx.export_graph(encoder, inputs, ["images"], tokens, folder / onnx.ENCODER)
        return {}

    def export(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(onnx, "_export_graphs", export_encoder)
            onnx.export(shallow_da3, folder / "bundle")

    return made_once(tmp_path_factory, "onnx", export) / "bundle"
