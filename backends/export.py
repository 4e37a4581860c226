"""Export of a frozen network to an ONNX bundle with dynamic numbers of scenes, views, rows and columns."""

from __future__ import annotations

import importlib.util
import os
import secrets
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor, nn
from torch.export import Dim

from backends.base import Backend
from backends.bundle import CONVENTIONS, DECODER, DECODER_WEIGHTS, ENCODER, Description, decoder_class, decoder_weights
from backends.da3 import DA3Backend
from backends.onnx import DECODED, open_session, run_session
from backends.vggt import VGGTBackend
from vg2gt.types import Cameras, Hints, Tokens

Exportable = VGGTBackend | DA3Backend

TRACED = (2, 3, 4, 6)  # traced scenes, views, patch rows, patch columns: all different, none 1
CHECKED = ((1, 1, 3, 2), (1, 2, 2, 5), (2, 4, 3, 3))
TOLERANCE = 1e-3  # relative error; a correct graph differs by about 1e-6, a wrong one by far more than 1e-3


class EncoderGraph(nn.Module):
    """Encoder for export: images, and cameras if used, to patch tokens ``[B, V, h, w, D]`` and a camera token."""

    def __init__(self, backend: Exportable) -> None:
        super().__init__()
        self.backend = backend

    def forward(
        self, images: Tensor, world_to_camera: Tensor | None = None, intrinsics: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Encodes ``[B, V, 3, H, W]`` images."""
        hints = None
        if world_to_camera is not None and intrinsics is not None:
            hints = Hints(cameras=Cameras(world_to_camera, intrinsics, (images.shape[-2], images.shape[-1])))
        tokens = self.backend.encode_checked(images, hints)
        return (*(tap.unflatten(2, tokens.grid) for tap in tokens.patch), tokens.camera)


class DecoderGraph(nn.Module):
    """Decoder for export: patch tokens ``[B, V, h, w, D]`` and a camera token to depth, confidence and cameras."""

    def __init__(self, backend: Exportable) -> None:
        super().__init__()
        self.backend = backend

    def forward(self, *tokens: Tensor) -> tuple[Tensor, ...]:
        """Decodes all views at once; the camera token is the last argument."""
        *patch, camera = tokens
        grid = (patch[0].shape[2], patch[0].shape[3])
        size = (grid[0] * self.backend.patch_size, grid[1] * self.backend.patch_size)
        flat = tuple(tap.flatten(2, 3) for tap in patch)
        geometry = self.backend.network.decode(Tokens(flat, camera, grid, size), None)
        return geometry.depth, geometry.depth_conf, geometry.cameras.world_to_camera, geometry.cameras.intrinsics


def export(backend: Backend, out: Path) -> Description:
    """Exports a bundle, and verifies it against torch at sizes other than the traced one.

    The bundle is written to a temporary folder, which is renamed to ``out`` at the end.

    Args:
        backend: backend to export, on the CPU.
        out: output folder; must not exist or be empty.

    Returns:
        The content of the folder's ``backend.json``.

    Raises:
        ValueError: if the backend cannot be exported.
        FileExistsError: if ``out`` is not empty.
        RuntimeError: if a dynamic size was fixed in the graph, or onnxruntime's results differ from torch's.
        ImportError: if ``onnx`` or ``onnxscript`` is not installed.
    """
    if not isinstance(backend, VGGTBackend | DA3Backend):
        raise ValueError(f"backend {backend.name} cannot be exported, only VGGT and the relative DA3 networks")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists already: remove it or choose another out=FOLDER")
    if not all(importlib.util.find_spec(package) for package in ("onnx", "onnxscript")):
        raise ImportError("export needs onnx and onnxscript: pip install 'vg2gt[export]'")
    folder = out.with_name(f".{out.name}.{secrets.token_hex(8)}.tmp")
    folder.mkdir(parents=True)
    try:
        description = _write(backend, folder)
        os.replace(folder, out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return description


def _write(backend: Exportable, folder: Path) -> Description:
    encoder, decoder = EncoderGraph(backend).eval(), DecoderGraph(backend).eval()
    inputs = example_inputs(backend, *TRACED)
    with torch.no_grad():
        tokens = encoder(*inputs)
    names = ["images", "world_to_camera", "intrinsics"][: len(inputs)]
    token_names = [*(f"patch_{index}" for index in range(len(backend.token_dims))), "camera"]
    export_graph(encoder, inputs, names, token_names, folder / ENCODER)
    export_graph(decoder, tokens, token_names, list(DECODED), folder / DECODER)
    (folder / DECODER_WEIGHTS).write_bytes(save(decoder_weights(backend.network)))
    description = Description(
        name=backend.name,
        licence=backend.licence,
        weights=backend.identity()["weights"],
        patch_size=backend.patch_size,
        token_dims=list(backend.token_dims),
        taps=[int(tap) for tap in backend.taps],
        needs_hints=backend.needs_hints,
        decoder={"class": decoder_class(backend.network).__name__, "arguments": backend.network.arguments},
        conventions=CONVENTIONS,
        max_difference=_compare(encoder, decoder, names, token_names, folder),
    )
    description.write(folder)
    return description


def example_inputs(backend: Exportable, scenes: int, views: int, rows: int, columns: int) -> tuple[Tensor, ...]:
    """Returns random images with the given number of patches and, if the backend uses them, cameras on a line."""
    size = (rows * backend.patch_size, columns * backend.patch_size)
    images = torch.rand(scenes, views, 3, *size, generator=torch.Generator().manual_seed(0))
    if not backend.needs_hints:
        return (images,)
    poses = torch.eye(4).repeat(scenes, views, 1, 1)
    poses[..., 0, 3] = torch.arange(views)
    intrinsics = torch.tensor([[size[1], 0, size[1] / 2], [0, size[1], size[0] / 2], [0, 0, 1]])
    return images, poses, intrinsics.repeat(scenes, views, 1, 1)


def export_graph(
    graph: nn.Module, inputs: tuple[Tensor, ...], names: Sequence[str], results: Sequence[str], file: Path
) -> None:
    """Exports a graph to ``file``; all axes are dynamic except channels and the rows and columns of matrices.

    Raises:
        RuntimeError: if a dynamic axis was fixed in the graph.
    """
    free = tuple(_free_axes(name) for name in names)
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass

    shapes = (free,) if isinstance(graph, DecoderGraph) else free  # the decoder takes *tokens
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exported = torch.export.export(graph, inputs, dynamic_shapes=shapes, strict=False)
        user_inputs = set(exported.graph_signature.user_inputs)
        nodes = [node for node in exported.graph.nodes if node.op == "placeholder" and node.name in user_inputs]
        for name, axes, node in zip(names, free, nodes, strict=True):
            shape = node.meta["val"].shape
            fixed = [axis for axis in axes if isinstance(shape[axis], int) or shape[axis].node.expr.is_number]
            if fixed:
                raise RuntimeError(
                    f"the export fixed axes {fixed} of {name} (shape {list(shape)}): code uses them as Python numbers"
                )
        program = torch.onnx.export(
            exported,
            input_names=names,
            output_names=results,
            dynamo=True,
            verbose=False,
            optimize=False,
            custom_translation_table={torch.ops.aten.scaled_dot_product_attention.default: _attention},
        )
    assert program is not None
    ClearMetadataAndDocStringPass()(program.model)  # removes stack traces, which hold local paths
    program.save(file)


def _attention(query: Any, key: Any, value: Any) -> Any:
    """Attention on ``[B, heads, N, head_dim]`` as onnxruntime's operator, which never stores the ``N x N`` weights."""
    from onnx.defs import OpSchema
    from onnxscript import opset18
    from onnxscript.values import Op, Opset

    op: Any = opset18  # its type hints reject single constant attributes
    parameter, attribute = OpSchema.FormalParameter, OpSchema.Attribute
    schema = OpSchema(  # the part of onnxruntime's documented schema that is used here
        "MultiHeadAttention",
        "com.microsoft",
        1,
        inputs=[parameter(name, "T") for name in ("query", "key", "value")],
        outputs=[parameter("output", "T")],
        type_constraints=[("T", ["tensor(float)"], "")],
        attributes=[attribute("num_heads", OpSchema.AttrType.INT, "")],
    )
    attend = Op(Opset("com.microsoft", 1), schema.name, schema)

    def joined(heads: Any) -> Any:  # [B, N, heads * head_dim]
        return op.Reshape(op.Transpose(heads, perm=[0, 2, 1, 3]), op.Constant(value_ints=[0, 0, -1]))

    heads = int(query.shape[1])
    out = op.Reshape(
        attend(joined(query), joined(key), joined(value), num_heads=heads), op.Constant(value_ints=[0, 0, heads, -1])
    )
    return op.Transpose(out, perm=[0, 2, 1, 3])


def _free_axes(name: str) -> dict[int, object]:
    axes = {"images": (0, 1, 3, 4), "world_to_camera": (0, 1), "intrinsics": (0, 1), "camera": (0, 1)}
    return dict.fromkeys(axes.get(name, (0, 1, 2, 3)), Dim.AUTO)


def _compare(
    encoder: EncoderGraph, decoder: DecoderGraph, names: Sequence[str], token_names: Sequence[str], folder: Path
) -> dict[str, float]:
    """Largest :func:`relative_difference` to torch per part, over all outputs at sizes other than the traced one."""
    worst = {}
    runs = (
        ("encoder", encoder, ENCODER, names, token_names),
        ("decoder", decoder, DECODER, token_names, DECODED),
    )
    for part, graph, file, keys, results in runs:
        session = open_session(folder / file, "cpu")
        worst[part] = 0.0
        for shape in CHECKED:
            inputs = example_inputs(encoder.backend, *shape)
            with torch.no_grad():
                inputs = inputs if graph is encoder else encoder(*inputs)
                expected = graph(*inputs)
            found = run_session(session, dict(zip(keys, inputs, strict=True)), results)
            worst[part] = max(worst[part], *map(relative_difference, found, expected))
            if not worst[part] <= TOLERANCE:
                raise RuntimeError(f"{file} differs from torch by {worst[part]:.1e} at {shape} scenes, views, patches")
    return worst


def relative_difference(found: Tensor, expected: Tensor) -> float:
    """Returns max|found - expected| / max|expected|; infinity if the shapes differ."""
    if found.shape != expected.shape:
        return float("inf")
    return float((found - expected).abs().max() / expected.abs().max())
