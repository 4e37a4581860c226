"""Models by name (issue 47, item 31): the shipped one, a folder, the hub."""

import shutil
from pathlib import Path

import pytest
import torch

import vg2gt
from vg2gt.runs.load import SHIPPED

FILES = ["model.calibration.json", "model.safetensors", "model.yaml"]


def test_a_name_a_folder_and_a_name_on_the_hub_give_the_same_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = vg2gt.save_pretrained(SHIPPED, tmp_path / "mine")
    assert sorted(path.name for path in folder.iterdir()) == FILES
    asked = []

    def download(repo: str, name: str, revision: str | None = None) -> str:
        asked.append((repo, name, revision))
        (tmp_path / "cache").mkdir(exist_ok=True)
        return str(shutil.copy(folder / name, tmp_path / "cache" / name))

    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    by_name = vg2gt.load("sweep-tiny", device="cpu")
    assert (vg2gt.list_models(), by_name.weights.path) == (("sweep-tiny",), SHIPPED)
    shipped = by_name.model.trained_state()
    for name, revision in ((folder, None), ("somebody/rooms", "v1")):
        found = vg2gt.load(name, revision=revision, device="cpu")
        assert found.calibration is not None
        state = found.model.trained_state()
        assert state.keys() == shipped.keys()
        assert all(torch.equal(state[name], shipped[name]) for name in shipped)
    assert asked == [("somebody/rooms", name, "v1") for name in FILES[:2]]
    with pytest.raises(FileNotFoundError, match="no such checkpoint or run"):
        vg2gt.load("nowhere", device="cpu")


def test_what_is_uploaded_is_data_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple] = []

    class Api:
        def create_repo(self, repo: str, private: bool, exist_ok: bool) -> None:
            calls.append((repo, private, exist_ok))

        def upload_folder(self, repo_id: str, folder_path: str, allow_patterns: list[str]) -> str:
            calls.append((repo_id, sorted(allow_patterns)))
            return "commit"

    monkeypatch.setattr("huggingface_hub.HfApi", Api)
    assert vg2gt.push_to_hub(SHIPPED, "me/rooms", tmp_path / "mine") == "commit"
    assert calls == [("me/rooms", False, True), ("me/rooms", FILES)]
