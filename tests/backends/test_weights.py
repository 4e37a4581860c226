import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra.errors import InstantiationException
from safetensors.torch import save_file
from torch import nn

from backends.weights import Weights, load_strictly


def published(backend, prefix: str = "model.") -> dict[str, torch.Tensor]:
    return {prefix + key: value.clone() for key, value in backend.network.state_dict().items()}


@pytest.fixture(scope="module")
def donor(make_backend):
    return make_backend("da3_tiny", "seed=5")


@pytest.mark.parametrize("name", ["model.safetensors", "other.pt"])
def test_weights_are_loaded_from_file_or_folder(tmp_path: Path, make_backend, donor, capsys, name: str) -> None:
    state = published(donor) | {"model.head.scratch.output_conv1_aux.0.0.weight": torch.zeros(1)}
    file = tmp_path / name
    save_file(state, file) if file.suffix == ".safetensors" else torch.save(state, file)
    path = file if name.startswith("other") else tmp_path
    backend = make_backend("da3_tiny", "pretrained=true", f"path={path}", "licence=Example-1.0")
    assert backend.identity()["weights"] == donor.identity()["weights"]
    assert "Example-1.0" in capsys.readouterr().out
    assert not any(parameter.requires_grad for parameter in backend.parameters())


def test_random_weights_depend_on_the_seed_alone(make_backend, donor) -> None:
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    again = make_backend("da3_tiny", "seed=5")
    assert torch.equal(torch.rand(1), expected)
    assert again.identity() == donor.identity()
    assert make_backend("da3_tiny").identity() != donor.identity()


def test_offending_tensors_are_named() -> None:
    network = nn.Sequential(nn.Linear(2, 3), nn.Linear(3, 1))
    state = {f"model.{key}": value for key, value in network.state_dict().items()}
    state["model.0.weight"] = torch.zeros(3, 4)
    del state["model.1.bias"]
    state["model.2.weight"] = torch.zeros(1)
    state["model.unused.weight"] = torch.zeros(1)
    with pytest.raises(ValueError, match="does not fit Sequential") as caught:
        load_strictly(network, state, "model.", ("model.unused.",), "some.pt")
    message = str(caught.value)
    for said in ("some.pt", 'Missing key(s) in state_dict: "1.bias"', "size mismatch for 0.weight", '"2.weight"'):
        assert said in message
    assert "unused" not in message
    state = {"weight": torch.zeros(2, 2), "bias": torch.tensor([0, torch.nan])}
    with pytest.raises(ValueError, match=r"x does not fit Linear: bias is not finite"):
        load_strictly(nn.Linear(2, 2), state, "", (), "x")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"path": "here"}, "pretrained=false requests random weights, but path=here is set"),
        ({"taps": [3, 1, 0, 2]}, r"backend\.taps=\[3, 1, 0, 2\] must be ascending"),
        ({"ffn": "swiglue"}, "backend.ffn is 'swiglue'; choose one of mlp, swiglu"),
    ],
)
def test_options_that_mean_nothing_are_refused(make_backend, options: dict[str, object], said: str) -> None:
    options = {"depth": 4, "multiview_from": 1, "taps": [0, 1, 2, 3], **options}
    changes = [f"{name}={value}" for name, value in options.items()]
    with pytest.raises(InstantiationException) as caught:
        make_backend("da3_tiny", *changes)
    assert re.search(said, str(caught.value.__cause__))


def test_missing_files_and_a_missing_hub_library_are_named(tmp_path: Path, monkeypatch) -> None:
    weights = Weights("name", "licence", True, "some/repo", None, str(tmp_path), 0)
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors.*backend\.pretrained=false.*some/repo"):
        weights.find()
    with pytest.raises(FileNotFoundError, match="no published weights"):
        replace(weights, repo=None, path=None).find()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"pip install 'vg2gt\[hub\]'"):
        replace(weights, path=None).find()


def test_the_hub_gives_weights_or_says_in_one_line_why_not(monkeypatch, tmp_path, make_backend, donor) -> None:
    """As its client raises where a file is neither there nor in the cache."""
    hub, asked = pytest.importorskip("huggingface_hub"), []
    save_file(published(donor), tmp_path / "model.safetensors")

    def download(repo: str, file: str, revision: str | None = None) -> str:
        asked.append((repo, file, revision))
        if revision == "v2":
            raise FileNotFoundError("not in\nthe cache.")
        return str(tmp_path / file)

    monkeypatch.setattr(hub, "hf_hub_download", download)
    options = ("da3_tiny", "pretrained=true", "repo=someone/da3")
    assert make_backend(*options).identity()["weights"] == donor.identity()["weights"]
    with pytest.raises(InstantiationException) as caught:
        make_backend(*options, "revision=v2")
    assert asked == [("someone/da3", "model.safetensors", revision) for revision in (None, "v2")]
    said = r"cannot get model\.safetensors of someone/da3 \(revision v2\) .*: not in the cache\. "
    assert re.match(said + r"Check .*backend\.path=.*backend\.pretrained=false", str(caught.value.__cause__))
