"""ONNX bundles: equal to torch at sizes never traced, refused when damaged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from backends import onnx as exporting
from backends.onnx import DESCRIPTION, Exportable, OnnxBackend, example_inputs, export, relative_difference
from vg2gt.types import Cameras, Hints

onnx = pytest.importorskip("onnx")

UNSEEN = [(1, 1, 5, 5), (2, 5, 3, 8), (3, 4, 2, 7), (1, 1, 1, 1)]  # scenes, views, patch rows, columns
LIMIT = 5e-5


def hints_of(inputs: tuple[torch.Tensor, ...]) -> Hints | None:
    images, *poses = inputs
    return Hints(cameras=Cameras(poses[0], poses[1], (images.shape[-2], images.shape[-1]))) if poses else None


def worst_difference(bundle: Path, expected: Exportable) -> float:
    """Of tokens and depth at every unseen size, and of both graphs at export if they were checked."""
    found = OnnxBackend(str(bundle))
    worst = max(json.loads((bundle / DESCRIPTION).read_text())["max_difference"].values(), default=0.0)
    for shape in UNSEEN:
        inputs = example_inputs(expected, *shape)
        tokens = expected.encode(inputs[0], hints_of(inputs))
        again = found.encode(inputs[0], hints_of(inputs))
        assert (again.grid, again.size) == (tokens.grid, tokens.size)
        pairs = [*zip((*again.patch, again.camera), (*tokens.patch, tokens.camera), strict=True)]
        pairs.append((found.decode(again).depth, expected.decode(tokens).depth))
        worst = max(worst, *(relative_difference(a, b) for a, b in pairs))
    return worst


@pytest.fixture
def copy(onnx_bundle: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(onnx_bundle, tmp_path / "copy"))


def edit(bundle: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the description."""
    description = json.loads((bundle / DESCRIPTION).read_text())
    change(description)
    (bundle / DESCRIPTION).write_text(json.dumps(description))


def test_da3_equals_torch_at_other_sizes(onnx_bundle: Path, shallow_da3: Exportable) -> None:
    assert worst_difference(onnx_bundle, shallow_da3) <= LIMIT
    assert OnnxBackend(str(onnx_bundle)).identity() == shallow_da3.identity()  # checkpoints fit the exported network


@pytest.mark.slow
@pytest.mark.parametrize(
    "override",
    ["vggt_tiny", "da3_tiny", "da3_small", "da3_tiny reference_view=saddle_balanced", "da3_tiny given_poses=true"],
)
def test_whole_networks_equal_torch(make_backend, tmp_path: Path, override: str) -> None:
    network = make_backend(*override.split(), "pretrained=false")
    differences = export(network, tmp_path / "bundle")["max_difference"]
    assert set(differences) == {"encoder", "decoder"}
    assert worst_difference(tmp_path / "bundle", network) <= LIMIT
    assert ("", "Softmax") not in operators(tmp_path / "bundle" / "decoder.onnx")


def operators(graph: Path) -> set[tuple[str, str]]:
    """Domains and names of its nodes' operators."""
    return {(node.domain, node.op_type) for node in onnx.load(graph, load_external_data=False).graph.node}


def test_attention_never_holds_the_weights_of_all_pairs(onnx_bundle: Path) -> None:
    found = operators(onnx_bundle / "encoder.onnx")
    assert ("", "Softmax") not in found
    assert ("com.microsoft", "MultiHeadAttention") in found


def test_missing_folder_and_files_and_what_is_not_onnx_are_named(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"backend\.path=FOLDER"):
        OnnxBackend()
    with pytest.raises(FileNotFoundError, match=r"nowhere is not an ONNX bundle.*vg2gt export"):
        OnnxBackend(str(tmp_path / "nowhere"))
    for content in (b"no protocol buffer at all", b"\x08\x08", b"\xff" * 64):
        (copy / "encoder.onnx").write_bytes(content)
        with pytest.raises(ValueError, match=r"encoder\.onnx"):
            OnnxBackend(str(copy))
    (copy / "decoder.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"decoder\.safetensors is missing"):
        OnnxBackend(str(copy))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("licence"), "licence"),
        (lambda d: d["decoder"].update({"class": "subprocess.Popen"}), "not describe a VGGTDecoder or DA3Decoder"),
        (lambda d: d["decoder"]["arguments"].update(features=-32), "not describe a VGGTDecoder or DA3Decoder"),
        (lambda d: d["decoder"]["arguments"].update(features=32), "does not fit DA3Decoder"),
    ],
)
def test_wrong_descriptions_are_refused(copy: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    edit(copy, change)
    with pytest.raises(ValueError, match=message):
        OnnxBackend(str(copy))


def test_export_refuses_what_it_cannot_do_and_leaves_nothing(make_backend, shallow_da3, tmp_path, monkeypatch) -> None:
    with pytest.raises(ValueError, match="oracle cannot be exported"):
        export(make_backend("oracle"), tmp_path / "out")
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="exists already"):
        export(shallow_da3, tmp_path)
    (tmp_path / "file").unlink()
    monkeypatch.setattr(exporting, "export_graph", Mock(side_effect=RuntimeError("no graph")))
    with pytest.raises(RuntimeError, match="no graph"):
        export(shallow_da3, tmp_path / "out")
    assert not list(tmp_path.iterdir())
