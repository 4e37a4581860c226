"""Checkpoints: atomic, checked, no code execution, initialisation from weights."""

import logging
import os
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from tests.io.mutations import mutations
from tests.reliability.crash_harness import assert_equal
from vg2gt.runs.checkpoints import initialize_from, newest, read_checkpoint, write_checkpoint
from vg2gt.training.start import prepare_folder


def test_a_save_reaches_the_disk_in_order_and_reads_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def noted_fsync(descriptor: int) -> None:
        done.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).suffix)
        fsync(descriptor)

    def noted_replace(source: Path, target: Path) -> None:
        done.append("rename")
        replace(source, target)

    monkeypatch.setattr("os.fsync", noted_fsync)
    monkeypatch.setattr("os.replace", noted_replace)
    path = tmp_path / "checkpoints" / "step-3.ckpt"
    write_checkpoint({"global_step": 3, "state_dict": {"w": torch.arange(4.0)}}, path)
    assert done == [".tmp", "rename", ""]  # file, name, folder
    assert torch.equal(read_checkpoint(path)["state_dict"]["w"], torch.arange(4.0))
    assert [p.name for p in path.parent.iterdir()] == ["step-3.ckpt"]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "step-3.ckpt"
    write_checkpoint({"global_step": 3}, path)

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torch.save", full)
    with pytest.raises(OSError, match=r"earlier checkpoints are intact"):
        write_checkpoint({"global_step": 4}, path)
    assert (read_checkpoint(path)["global_step"], len(list(tmp_path.iterdir()))) == (3, 1)


def test_flipped_bits_in_weights_are_found(tmp_path: Path) -> None:
    """torch.load alone takes them."""
    path, weights = tmp_path / "step-1.ckpt", torch.arange(1000.0)
    write_checkpoint({"w": weights}, path)
    content = bytearray(path.read_bytes())
    content[content.find(weights.numpy().tobytes()) + 2001] ^= 4
    path.write_bytes(content)
    assert not torch.equal(torch.load(path, weights_only=True)["w"], weights)
    with pytest.raises(ValueError, match="wrong checksum of"):
        read_checkpoint(path)


def test_damaged_checkpoints_are_never_taken(tmp_path: Path) -> None:
    """Either refused or, where only padding was hit, exactly what was saved."""
    module = nn.Linear(16, 16)
    optimizer = torch.optim.AdamW(module.parameters())
    for step in (1, 2):
        module(torch.ones(1, 16)).sum().backward()
        optimizer.step()
        saved = {"state_dict": module.state_dict(), "optimizer_states": [optimizer.state_dict()], "global_step": step}
        write_checkpoint(saved, tmp_path / f"step-{step}.ckpt")
    path, refused = newest(tmp_path), 0
    whole = [read_checkpoint(tmp_path / f"step-{step}.ckpt") for step in (1, 2)]
    first, content = (tmp_path / "step-1.ckpt").read_bytes(), path.read_bytes()
    spliced = [first[:place] + content[place:] for place in range(100, len(content), 100)]
    for damaged in (*mutations(content, 300), *spliced):
        path.write_bytes(damaged)
        try:
            found = read_checkpoint(path)  # which may be the other one, spliced whole
        except ValueError as error:
            refused += "step-2.ckpt is damaged" in str(error) and "delete it to resume" in str(error)
        else:
            assert_equal(whole[found["global_step"] - 1], found, "taken")
    assert refused > 0.8 * (300 + len(spliced))


def test_leftovers_are_cleared(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    write_checkpoint({"global_step": 1}, folder / "step-1.ckpt")
    (folder / "step-5.ckpt.tmp").write_bytes(b"half")
    (tmp_path / ".metrics.json.123.tmp").write_bytes(b"half")
    (tmp_path / "notes.tmp").write_bytes(b"the user's")
    prepare_folder(OmegaConf.create({"output_dir": str(tmp_path)}), newest(folder))
    assert [path.name for path in folder.iterdir()] == ["step-1.ckpt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "config.yaml", "notes.tmp"]


def test_initialize_from_names_the_layers_that_start_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    old = nn.ModuleDict({"body": nn.Linear(4, 4), "out": nn.Linear(4, 28)})
    new = nn.ModuleDict({"body": nn.Linear(4, 4), "out": nn.Linear(4, 14)})
    fresh, trained = new.state_dict()["out.weight"].clone(), old.state_dict()["body.weight"]
    path = tmp_path / "step-5.ckpt"
    write_checkpoint({"state_dict": old.state_dict()}, path)
    with caplog.at_level(logging.INFO):
        initialize_from(new, path)
    assert torch.equal(new.state_dict()["body.weight"], trained)
    assert torch.equal(new.state_dict()["out.weight"], fresh)
    assert "re-initialised layers: out" in caplog.text
    with pytest.raises(ValueError, match="none of its"):
        initialize_from(nn.ModuleDict({"other": nn.Linear(2, 2)}), path)
