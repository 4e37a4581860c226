"""ONNX bundles: no code of their own, no class but our decoders."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from backends.onnx import DECODER_WEIGHTS, DESCRIPTION, ENCODER, OnnxBackend, open_session

onnx = pytest.importorskip("onnx", reason="needs onnx: pip install 'vg2gt[export]'")
from onnx import TensorProto, helper  # noqa: E402

OF_ENCODER = {"patch_0": 4, "camera": 1}  # outputs and their sizes, as the description promises them


def network(node: Any, domain: str = "") -> bytes:
    """A network whose node makes ``y`` of ``x``, and the outputs of ``y``."""
    shape, nodes = helper.make_tensor_value_info, [node]
    for name, size in OF_ENCODER.items():
        nodes.append(helper.make_node("Constant", [], [f"size of {name}"], value_ints=[size]))
        nodes.append(helper.make_node("Expand", ["y", f"size of {name}"], [name]))
    made = [shape(name, TensorProto.FLOAT, [size]) for name, size in OF_ENCODER.items()]
    graph = helper.make_graph(nodes, "g", [shape("x", TensorProto.FLOAT, [1])], made)
    opsets = [helper.make_opsetid("", 17), *([helper.make_opsetid(domain, 1)] if domain else [])]
    return helper.make_model(graph, opset_imports=opsets, ir_version=9).SerializeToString()


HARMLESS = network(helper.make_node("Identity", ["x"], ["y"]))


def describe(folder: Path, change: Callable[[dict[str, Any]], Any] = lambda content: None) -> None:
    """Writes a description, then changed."""
    known: dict[str, Any] = {
        "name": "da3_tiny",
        "licence": "mine",
        "weights": "0" * 64,
        "patch_size": 14,
        "token_dims": [4],
    }
    known |= {"needs_hints": False, "decoder": {"class": "DA3Decoder", "arguments": {}}, "max_difference": {}}
    change(known)
    (folder / DESCRIPTION).write_text(json.dumps(known))


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    folder = tmp_path / "bundle"
    folder.mkdir()
    (folder / ENCODER).write_bytes(HARMLESS)
    save_file({"w": np.zeros(1)}, folder / DECODER_WEIGHTS)
    describe(folder)
    return folder


@pytest.mark.parametrize(
    ("domain", "operator", "attributes"),
    [
        ("com.evil", "Run", {"command": "touch canary"}),
        ("ai.onnx.contrib", "PyOp", {"code": "open('canary', 'w')"}),
        ("com.microsoft", "EPContext", {"ep_cache_context": "../engine.bin", "embed_mode": 0}),
        ("", "NoSuchOperator", {}),
    ],
)
def test_operators_of_their_own(bundle: Path, canary: Path, domain: str, operator: str, attributes: dict) -> None:
    node = helper.make_node(operator, ["x"], ["y"], domain=domain, **attributes)
    (bundle / ENCODER).write_bytes(network(node, domain=domain))
    with pytest.raises(ValueError, match=r"onnxruntime .* cannot open .*encoder\.onnx"):
        OnnxBackend(str(bundle))


def test_libraries_in_the_folder_are_never_opened(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (bundle / "custom_ops.so").write_bytes(b"\x7fELF")
    opened = []
    monkeypatch.setattr("onnxruntime.SessionOptions.register_custom_ops_library", lambda *a: opened.append(a))
    model = onnx.load_from_string(HARMLESS)
    config = {"session_options": {"custom_ops_library": "custom_ops.so"}}
    model.metadata_props.add(key="ort_config", value=json.dumps(config))
    (bundle / ENCODER).write_bytes(model.SerializeToString())
    open_session(bundle / ENCODER)
    assert not opened


CALL = {"_target_": "os.system", "_args_": ["touch canary"]}
DESCRIPTIONS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a target": lambda content: content.update(_target_="os.system"),
    "decoder a target": lambda content: content.update(decoder=CALL),
    "class a path": lambda content: content["decoder"].update({"class": "../decoder.py:Decoder"}),
    "class a list": lambda content: content["decoder"].update({"class": ["DA3Decoder"]}),
    "arguments a target": lambda content: content["decoder"].update(arguments=CALL),
}


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_descriptions(bundle: Path, canary: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(bundle.parent)
    describe(bundle, DESCRIPTIONS[name])
    with pytest.raises((ValueError, FileNotFoundError), match=r"bundle"):
        OnnxBackend(str(bundle))
