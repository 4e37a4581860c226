"""ONNX bundles: equal to torch at sizes never traced, refused when damaged, decoded with and without gradient."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from backends import onnx as exporting
from backends.base import Backend
from backends.onnx import DESCRIPTION, Exportable, OnnxBackend, example_inputs, export, relative_difference
from vg2gt.types import Cameras, Geometry, Hints

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

UNSEEN = [(1, 1, 5, 5), (1, 2, 6, 4), (2, 5, 3, 8), (3, 4, 2, 7), (1, 1, 1, 1)]  # scenes, views, patch rows, columns
LIMIT = 5e-5


def hints_of(inputs: tuple[torch.Tensor, ...]) -> Hints | None:
    images, *poses = inputs
    return Hints(cameras=Cameras(poses[0], poses[1], (images.shape[-2], images.shape[-1]))) if poses else None


def parts(geometry: Geometry) -> tuple[torch.Tensor, ...]:
    return geometry.depth, geometry.depth_conf, geometry.cameras.world_to_camera, geometry.cameras.intrinsics


def worst_difference(found: Backend, expected: Exportable) -> float:
    """Over tokens and geometry at every unseen size; the decoder is compared on equal tokens too."""
    worst = 0.0
    for shape in UNSEEN:
        inputs = example_inputs(expected, *shape)
        tokens = expected.encode(inputs[0], hints_of(inputs))
        again = found.encode(inputs[0], hints_of(inputs))
        assert (again.grid, again.size) == (tokens.grid, tokens.size)
        geometry = expected.decode(tokens)
        pairs = [*zip((*again.patch, again.camera), (*tokens.patch, tokens.camera), strict=True)]
        for given in (tokens, again):
            pairs += zip(parts(found.decode(given)), parts(geometry), strict=True)
        worst = max(worst, *(relative_difference(a, b) for a, b in pairs))
    return worst


def without_weights(bundle: Path) -> OnnxBackend:
    (bundle / "decoder.safetensors").unlink()
    with pytest.warns(UserWarning, match="decodes without gradient"):
        return OnnxBackend(str(bundle))


@pytest.fixture
def copy(onnx_bundle: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(onnx_bundle, tmp_path / "copy"))


def edit(bundle: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the description."""
    description = json.loads((bundle / DESCRIPTION).read_text())
    change(description)
    (bundle / DESCRIPTION).write_text(json.dumps(description))


def test_da3_equals_torch_at_other_sizes(onnx_bundle: Path, shallow_da3: Exportable) -> None:
    backend = OnnxBackend(str(onnx_bundle))
    assert backend.supports_gradient
    assert backend.identity() == shallow_da3.identity()  # checkpoints fit the exported network
    assert worst_difference(backend, shallow_da3) <= LIMIT


def test_decoder_graph_equals_torch_at_other_sizes(copy: Path, shallow_da3: Exportable) -> None:
    backend = without_weights(copy)
    assert not backend.supports_gradient
    assert worst_difference(backend, shallow_da3) <= LIMIT
    tokens = shallow_da3.encode(example_inputs(shallow_da3, 1, 2, 3, 4)[0])
    changed = tokens.with_patch(tuple(patch.clone().requires_grad_() for patch in tokens.patch))
    assert not backend.decode(changed).depth.requires_grad


@pytest.mark.slow
@pytest.mark.parametrize(
    "override",
    ["vggt_tiny", "da3_tiny", "da3_small", "da3_tiny reference_view=saddle_balanced", "da3_tiny given_poses=true"],
)
def test_whole_networks_equal_torch(make_backend, tmp_path: Path, override: str) -> None:
    network = make_backend(*override.split(), "pretrained=false")
    export(network, tmp_path / "bundle")
    differences = [worst_difference(OnnxBackend(str(tmp_path / "bundle")), network)]
    differences.append(worst_difference(without_weights(tmp_path / "bundle"), network))
    print(f"{override}: torch decoder {differences[0]:.1e}, ONNX decoder {differences[1]:.1e}")
    assert max(differences) <= LIMIT


@pytest.mark.parametrize("name", ["encoder.onnx", "decoder.onnx"])
def test_attention_never_holds_the_weights_of_all_pairs(onnx_bundle: Path, name: str) -> None:
    model = onnx.load(onnx_bundle / name, load_external_data=False)
    kinds = {(node.domain, node.op_type) for node in model.graph.node}
    assert ("", "Softmax") not in kinds
    assert (("com.microsoft", "MultiHeadAttention") in kinds) == (name == "encoder.onnx")


def test_missing_folder_and_files_and_what_is_not_onnx_are_named(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"backend\.path=FOLDER"):
        OnnxBackend()
    with pytest.raises(FileNotFoundError, match=r"nowhere is not an ONNX bundle.*vg2gt export"):
        OnnxBackend(str(tmp_path / "nowhere"))
    for content in (b"no protocol buffer at all", b"\x08\x08", b"\xff" * 64):
        (copy / "encoder.onnx").write_bytes(content)
        with pytest.raises(ValueError, match=r"encoder\.onnx"):
            OnnxBackend(str(copy))
    (copy / "encoder.onnx").unlink()
    with pytest.raises(FileNotFoundError, match=r"encoder\.onnx is missing"):
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


def test_providers_are_checked(onnx_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="auto, cpu, cuda"):
        OnnxBackend(str(onnx_bundle), provider="tpu")  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(RuntimeError, match=r"onnxruntime-gpu.*backend\.provider=cpu"):
        OnnxBackend(str(onnx_bundle), provider="cuda")


@pytest.mark.gpu
@pytest.mark.skipif(
    "CUDAExecutionProvider" not in onnxruntime.get_available_providers(), reason="needs onnxruntime-gpu"
)
def test_cuda_provider_equals_torch(onnx_bundle: Path, shallow_da3: Exportable) -> None:
    assert worst_difference(OnnxBackend(str(onnx_bundle), provider="cuda"), shallow_da3) <= LIMIT


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
