"""Checkpoints: atomic, newest valid, no code execution, initialisation from weights."""

import logging
import pickle
from pathlib import Path

import pytest
import torch
from torch import nn

from vg2gt.checkpoints import AtomicCheckpointIO, initialize_from, newest_valid, read_checkpoint


def test_save_is_atomic_and_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "checkpoints" / "step-3.ckpt"
    AtomicCheckpointIO().save_checkpoint({"global_step": 3, "state_dict": {"w": torch.arange(4.0)}}, path)
    assert torch.equal(read_checkpoint(path)["state_dict"]["w"], torch.arange(4.0))
    assert [p.name for p in path.parent.iterdir()] == ["step-3.ckpt"]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "step-3.ckpt"
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({"global_step": 3}, path)

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torch.save", full)
    with pytest.raises(OSError, match=r"earlier checkpoints are intact"):
        writer.save_checkpoint({"global_step": 4}, path)
    assert read_checkpoint(path)["global_step"] == 3
    assert len(list(tmp_path.iterdir())) == 1


def test_newest_valid_passes_over_damaged_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    writer = AtomicCheckpointIO()
    for step in (9, 10, 100):
        writer.save_checkpoint({"global_step": step}, tmp_path / f"step-{step}.ckpt")
    assert newest_valid(tmp_path).name == "step-100.ckpt"
    content = (tmp_path / "step-100.ckpt").read_bytes()
    (tmp_path / "step-100.ckpt").write_bytes(content[: len(content) // 2])
    with caplog.at_level(logging.WARNING):
        assert newest_valid(tmp_path).name == "step-10.ckpt"
    assert "step-100.ckpt" in caplog.text


def test_no_valid_checkpoint_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "step-1.ckpt").write_bytes(b"nothing")
    with pytest.raises(FileNotFoundError, match="ckpt=last found no valid checkpoint"):
        newest_valid(tmp_path)


class Malicious:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_loading_never_executes_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Malicious()}, tmp_path / "step-1.ckpt")
    (tmp_path / "step-2.ckpt").write_bytes(pickle.dumps(Malicious()))
    for name in ("step-1.ckpt", "step-2.ckpt"):
        with pytest.raises(ValueError, match="damaged or not a checkpoint"):
            AtomicCheckpointIO().load_checkpoint(tmp_path / name, weights_only=False)
    assert not (tmp_path / "executed").exists()


def test_initialize_from_names_the_layers_that_start_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    old = nn.ModuleDict({"body": nn.Linear(4, 4), "out": nn.Linear(4, 28)})
    new = nn.ModuleDict({"body": nn.Linear(4, 4), "out": nn.Linear(4, 14)})
    fresh, trained = new.state_dict()["out.weight"].clone(), old.state_dict()["body.weight"]
    path = tmp_path / "step-5.ckpt"
    AtomicCheckpointIO().save_checkpoint({"state_dict": old.state_dict()}, path)
    with caplog.at_level(logging.INFO):
        initialize_from(new, path)
    assert torch.equal(new.state_dict()["body.weight"], trained)
    assert torch.equal(new.state_dict()["out.weight"], fresh)
    assert "re-initialised layers: out" in caplog.text
    with pytest.raises(ValueError, match="none of its"):
        initialize_from(nn.ModuleDict({"other": nn.Linear(2, 2)}), path)
