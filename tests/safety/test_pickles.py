"""Nothing that is loaded is unpickled: checkpoints, weights, arrays, caches."""

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from backends.vggt import VGGTBackend
from tests.data.sources.layout_rgbd import write_recording
from tests.safety.conftest import Armed
from vg2gt.data import DataError, RGBDFolder
from vg2gt.io.arrays import load_matrices, load_npy, load_npz, read_npz
from vg2gt.io.errors import FormatError
from vg2gt.io.tensors import read_tensors
from vg2gt.metrics.images import load_lpips
from vg2gt.runs.checkpoints import initialize_from, read_checkpoint
from vg2gt.runs.load import load_model
from vg2gt.training.checkpointing import AtomicCheckpointIO


def by_torch(content: object, zipped: bool = True) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


def script(armed: Armed) -> bytes:
    """A TorchScript archive holds code: constants.pkl, and code/ to be compiled."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("m/data.pkl", pickle.dumps(armed))
        archive.writestr("m/constants.pkl", pickle.dumps(armed))
        archive.writestr("m/code/__torch__.py", "import os")
        archive.writestr("m/version", "3\n")
    return buffer.getvalue()


def by_name(armed: Armed) -> bytes:
    """No class at all: the opcodes themselves."""
    return b"cos\nsystem\n(S'touch " + str(armed.canary).encode() + b"'\ntR."


PICKLES: dict[str, Callable[[Armed], bytes]] = {
    "zip": lambda armed: by_torch({"global_step": 1, "state_dict": {"w": armed}}),
    "legacy": lambda armed: by_torch({"w": armed}, zipped=False),
    "pickle 0": lambda armed: pickle.dumps(armed, 0),
    "pickle 5": lambda armed: pickle.dumps({"w": armed}, 5),
    "opcodes": by_name,
    "script": script,
}


def test_the_attack_works(tmp_path: Path) -> None:
    pickle.loads(by_name(Armed(tmp_path / "first")))
    torch.load(io.BytesIO(by_torch(Armed(tmp_path / "second"))), weights_only=False)
    assert (tmp_path / "first").exists()
    assert (tmp_path / "second").exists()


@pytest.mark.filterwarnings("ignore:'torch.load' received a zip file")
@pytest.mark.parametrize("kind", PICKLES)
def test_checkpoints(run_folder: Path, armed: Armed, kind: str) -> None:
    path = run_folder / "checkpoints" / "step-7.ckpt"
    path.write_bytes(PICKLES[kind](armed))
    for read in (
        lambda: read_checkpoint(path),
        lambda: AtomicCheckpointIO().load_checkpoint(path, weights_only=False),
        lambda: initialize_from(torch.nn.Linear(1, 1), path),
        lambda: load_model(path, device="cpu"),
    ):
        with pytest.raises(ValueError, match=r"step-7\.ckpt is damaged or not a checkpoint"):
            read()


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("kind", PICKLES)
@pytest.mark.parametrize("suffix", [".pt", ".pth", ".safetensors"])
def test_weights(tmp_path: Path, armed: Armed, kind: str, suffix: str) -> None:
    path = tmp_path / f"model{suffix}"
    path.write_bytes(PICKLES[kind](armed))
    for read in (
        lambda: read_tensors(path),
        lambda: VGGTBackend(pretrained=True, path=str(path)),
        *([lambda: load_lpips(str(path))] if suffix != ".pt" else []),
    ):
        with pytest.raises(FormatError, match=rf"model\{suffix} (is damaged or|holds programs)"):
            read()


def saved(name: str, array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{name: array})  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def test_arrays(tmp_path: Path, pickled_array: np.ndarray, armed: Armed) -> None:
    path, flat = tmp_path / "scene.npz", tmp_path / "depth.npy"
    np.save(flat, pickled_array, allow_pickle=True)
    np.load(io.BytesIO(saved("depth", np.zeros(1))))
    for content in (saved("depth", pickled_array), pickle.dumps(armed), flat.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(FormatError, match=r"not a readable archive|single array"):
            read_npz(path, ("depth",))
        for read, expected in ((load_npz, ("depth",)), (load_matrices, {"depth": (None,)})):
            with pytest.raises(DataError, match=r"cannot read .*scene\.npz of scene s"):
                read(path, "s", expected)
    for content in (flat.read_bytes(), pickle.dumps(armed), saved("depth", np.zeros(1))):
        flat.write_bytes(content)
        with pytest.raises(DataError, match=r"cannot read|is not a depth image"):
            load_npy(flat, "s", (1, 1))


def test_index_caches(rooms, tmp_path, pickled_array, armed, caplog):
    cache = tmp_path / "cache"

    write_recording(tmp_path, rooms.load(rooms.scenes[0], [0, 1]))

    def frames() -> list[int]:
        source = RGBDFolder(str(tmp_path / "office"), holdout=None, index_cache=str(cache))
        return list(source.frames(source.scenes[0]))

    assert frames() == [10, 11]
    (path,) = cache.rglob("*.npz")
    with np.load(path) as stored:
        good = dict(stored)
    for name in ("facts", "color", "frame_ids"):
        caplog.clear()
        np.savez(path, **{**good, name: pickled_array})  # pyright: ignore[reportArgumentType]
        assert frames() == [10, 11]
        assert "the cached index is damaged and will be rebuilt" in caplog.text
    path.write_bytes(pickle.dumps(armed))
    assert frames() == [10, 11]
