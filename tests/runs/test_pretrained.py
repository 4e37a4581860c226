"""Models by name (issue 47, item 31): the shipped one, a folder, the hub."""

import shutil
from pathlib import Path

import pytest
import torch

import vg2gt
from vg2gt.runs.load import SHIPPED


def test_the_shipped_model_has_a_name() -> None:
    assert vg2gt.list_models() == ("sweep-tiny",)
    loaded = vg2gt.from_pretrained("sweep-tiny", device="cpu")
    assert loaded.weights.path == SHIPPED


def test_a_folder_and_a_name_on_the_hub_give_the_same_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = vg2gt.save_pretrained(SHIPPED, tmp_path / "mine")
    assert sorted(path.name for path in folder.iterdir()) == [
        "model.calibration.json",
        "model.safetensors",
        "model.yaml",
    ]
    asked = []

    def download(repo: str, name: str, revision: str | None = None) -> str:
        asked.append((repo, name, revision))
        (tmp_path / "cache").mkdir(exist_ok=True)
        return str(shutil.copy(folder / name, tmp_path / "cache" / name))

    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    found = (
        vg2gt.from_pretrained(folder, device="cpu"),
        vg2gt.from_pretrained("somebody/rooms", revision="v1", device="cpu"),
    )
    assert all(each.calibration is not None for each in found)
    one, other = (each.model for each in found)
    assert asked == [("somebody/rooms", name, "v1") for name in ("model.calibration.json", "model.safetensors")]
    shipped = vg2gt.load_model(device="cpu").model.trained_state()
    for state in (one.trained_state(), other.trained_state()):
        assert state.keys() == shipped.keys()
        assert all(torch.equal(state[name], shipped[name]) for name in shipped)


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
    assert calls == [
        ("me/rooms", False, True),
        ("me/rooms", ["model.calibration.json", "model.safetensors", "model.yaml"]),
    ]


def test_no_such_model() -> None:
    with pytest.raises(FileNotFoundError, match="no such checkpoint or run"):
        vg2gt.from_pretrained("nowhere", device="cpu")
