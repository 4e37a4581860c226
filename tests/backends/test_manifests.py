"""Full-size networks have exactly the tensors of the published files, but for those named as not needed."""

import pytest
import torch
from torch import nn

from backends.da3 import DA3NestedBackend
from backends.da3.backend import RAY_BRANCH
from backends.weights import load_strictly
from tests.references import read_json
from vg2gt.baselines.da3_gaussians import GaussianHead

CASES = {
    "vggt_1b": ("vggt-1b", ()),
    **{f"da3_{size}": (f"da3-{size}", ("given_poses=true",)) for size in ("small", "base", "large", "giant")},
    "da3_metric_large": ("da3metric-large", ()),
    "da3_nested": ("da3nested-giant-large", ("relative.given_poses=true",)),
}


def tensors(network: nn.Module, prefix: str) -> dict[str, list[int]]:
    return {prefix + key: list(value.shape) for key, value in network.state_dict().items()}


@pytest.mark.parametrize("name", CASES)
def test_names_and_shapes(make_backend, name: str) -> None:
    file, overrides = CASES[name]
    manifest = read_json("manifests")[file]
    nested = name == "da3_nested"
    random = ["relative.pretrained=false", "metric.pretrained=false"] if nested else ["pretrained=false"]
    with torch.device("meta"):
        backend = make_backend(name, *random, *overrides)
    if isinstance(backend, DA3NestedBackend):
        ours = tensors(backend.relative.network, "model.da3.") | tensors(backend.metric.network, "model.da3_metric.")
    else:
        ours = tensors(backend.network, manifest["hub_prefix"])
    # Camera encoder and sky are named as not needed, but are part of our networks; the ray branch is not.
    unused = [key for key in manifest["ignorable_prefixes"] if "cam_enc" not in key and "sky" not in key]
    unused += ["model.da3." + key for key in RAY_BRANCH] if nested else []
    published = {key: shape for key, shape in manifest["tensors"].items() if not key.startswith(tuple(unused))}
    assert ours == published


@pytest.mark.parametrize("name", ["vggt_1b", "da3_small", "da3_large", "da3_giant"])
def test_a_published_file_would_load(make_backend, name: str) -> None:
    """Without the camera encoder, exactly as the YAML says: every leftover of the file is known."""
    manifest = read_json("manifests")[CASES[name][0]]
    with torch.device("meta"):
        backend = make_backend(name, "pretrained=false")
        state = {key: torch.empty(shape) for key, shape in manifest["tensors"].items()}
    assert backend.weights.repo in manifest["hub_repos"]
    load_strictly(backend.network, state, backend.weights.prefix, backend.weights.ignorable, "file")


def test_names_and_shapes_of_the_gaussian_head(make_backend) -> None:
    with torch.device("meta"):
        head = GaussianHead(**make_backend("da3_giant", "pretrained=false").network.arguments)
    prefix = "model.gs_head."
    published = read_json("manifests")["da3-giant"]["tensors"]
    assert tensors(head, prefix) == {key: shape for key, shape in published.items() if key.startswith(prefix)}
