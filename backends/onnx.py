"""ONNX bundles: folders with a frozen network split into encoder and decoder; written by ``vg2gt export``.

The encoder runs in onnxruntime, the decoder is rebuilt as a torch module from its class and arguments.

``backend.json`` holds ``name``, ``licence``, ``patch_size`` and ``token_dims`` of the exported backend, sha256 of its
``weights`` (checkpoints are matched with it), ``needs_hints`` (whether the encoder also takes ``world_to_camera`` and
``intrinsics``), ``class`` and ``arguments`` of the ``decoder``, and ``max_difference`` (largest relative difference of
``encoder`` and ``decoder`` to torch at export).
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import onnxruntime
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.export import Dim

from backends.base import Backend
from backends.da3.backend import DA3Backend, DA3Decoder
from backends.vggt import VGGTBackend, VGGTDecoder
from backends.weights import load_strictly
from vg2gt.io.files import read_json, whole_folder, write_json
from vg2gt.io.tensors import read_tensors
from vg2gt.types import Cameras, Geometry, Hints, Tokens

Exportable = VGGTBackend | DA3Backend

DESCRIPTION = "backend.json"
FIELDS = ("name", "licence", "weights", "patch_size", "token_dims", "needs_hints", "decoder")
ENCODER, _DECODER, DECODER_WEIGHTS = "encoder.onnx", "decoder.onnx", "decoder.safetensors"
_REMEDY = "write it with vg2gt export backend=NAME --out FOLDER"
_DECODERS = {kind.__name__: kind for kind in (VGGTDecoder, DA3Decoder)}  # the only classes that are built from a file
DECODED = ("depth", "depth_conf", "world_to_camera", "intrinsics")
CUDA = "CUDAExecutionProvider"
TRACED = (2, 3, 4, 6)  # traced scenes, views, patch rows, patch columns: all different, none 1
_CHECKED = ((1, 1, 3, 2), (1, 2, 2, 5), (2, 4, 3, 3))
TOLERANCE = 1e-3  # relative error; a correct graph differs by about 1e-6, a wrong one by far more than 1e-3


class Graph(nn.Module):
    """Part of a backend as a function of tensors, for export: :func:`encode_tensors` or :func:`_decode_tensors`."""

    def __init__(self, backend: Exportable, function: Callable[..., tuple[Tensor, ...]]) -> None:
        super().__init__()
        self.backend, self.function = backend, function

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Applies the function."""
        return self.function(self.backend, *inputs)


def encode_tensors(backend: Exportable, images: Tensor, *cameras: Tensor) -> tuple[Tensor, ...]:
    """Encodes ``[B, V, 3, H, W]`` images; world-to-camera matrices and intrinsics follow if they are used.

    Returns:
        Patch tokens ``[B, V, h, w, D]`` of every tap, and the camera token.
    """
    hints = Hints(cameras=Cameras(cameras[0], cameras[1], (images.shape[-2], images.shape[-1]))) if cameras else None
    tokens = backend.encode_checked(images, hints)
    return (*(tap.unflatten(2, tokens.grid) for tap in tokens.patch), tokens.camera)


def _decode_tensors(backend: Exportable, *tokens: Tensor) -> tuple[Tensor, ...]:
    """Decodes the results of :func:`encode_tensors`, all views at once, to depth, confidence, poses and intrinsics."""
    *patch, camera = tokens
    grid = (patch[0].shape[2], patch[0].shape[3])
    size = (grid[0] * backend.patch_size, grid[1] * backend.patch_size)
    flat = tuple(tap.flatten(2, 3) for tap in patch)
    geometry = backend.network.decode(Tokens(flat, camera, grid, size), None)
    return geometry.depth, geometry.depth_conf, geometry.cameras.world_to_camera, geometry.cameras.intrinsics


def export(backend: Backend, out: Path) -> dict[str, Any]:
    """Exports a bundle, and verifies it against torch at sizes other than the traced one.

    Args:
        backend: backend to export, on the CPU.
        out: output folder; must not exist or be empty.

    Returns:
        The content of ``backend.json``.

    Raises:
        ValueError: if the backend cannot be exported.
        FileExistsError: if ``out`` is not empty.
        RuntimeError: if onnxruntime's results differ from torch's.
        ImportError: if ``onnx`` or ``onnxscript`` is not installed.
    """
    if not isinstance(backend, VGGTBackend | DA3Backend):
        raise ValueError(f"backend {backend.name} cannot be exported, only VGGT and the relative DA3 networks")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists already: remove it or choose another out=FOLDER")
    if not all(importlib.util.find_spec(package) for package in ("onnx", "onnxscript")):
        raise ImportError("export needs onnx and onnxscript: pip install 'vg2gt[export]'")
    kind = "VGGTDecoder" if isinstance(backend, VGGTBackend) else "DA3Decoder"
    with torch.device("meta"):
        names = _DECODERS[kind](**backend.network.arguments).state_dict()
    state = backend.network.state_dict()
    description = {
        **backend.identity(),
        "licence": backend.licence,
        "patch_size": backend.patch_size,
        "token_dims": list(backend.token_dims),
        "needs_hints": backend.needs_hints,
        "decoder": {"class": kind, "arguments": backend.network.arguments},
    }
    with whole_folder(out) as folder:
        save_file({name: state[name].contiguous() for name in names}, folder / DECODER_WEIGHTS)
        description["max_difference"] = _export_graphs(backend, folder)
        write_json(folder / DESCRIPTION, description)
    return description


def _export_graphs(backend: Exportable, folder: Path) -> dict[str, float]:
    """Writes both graphs; returns their largest :func:`relative_difference` to torch, at sizes not traced."""
    encoder, decoder = (Graph(backend, function).eval() for function in (encode_tensors, _decode_tensors))
    tokens = token_names(len(backend.token_dims))
    names = ["images", "world_to_camera", "intrinsics"][: 3 if backend.needs_hints else 1]
    worst = {"encoder": 0.0, "decoder": 0.0}
    with torch.no_grad():
        inputs = example_inputs(backend, *TRACED)
        export_graph(encoder, inputs, names, tokens, folder / ENCODER)
        export_graph(decoder, encoder(*inputs), tokens, DECODED, folder / _DECODER)
        sessions = [open_session(folder / file) for file in (ENCODER, _DECODER)]
        for shape in _CHECKED:
            inputs = example_inputs(backend, *shape)
            encoded = encoder(*inputs)
            found = _run_session(sessions[0], dict(zip(names, inputs, strict=True)), tokens)
            worst["encoder"] = max(worst["encoder"], *map(relative_difference, found, encoded))
            found = _run_session(sessions[1], dict(zip(tokens, encoded, strict=True)), DECODED)
            worst["decoder"] = max(worst["decoder"], *map(relative_difference, found, decoder(*encoded)))
    if max(worst.values()) > TOLERANCE:
        raise RuntimeError(f"the exported graphs differ from torch: {worst}")
    return worst


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
    """Exports a graph to ``file``; all axes are dynamic except channels and the rows and columns of matrices."""
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass

    axes = {"images": (0, 1, 3, 4), "world_to_camera": (0, 1), "intrinsics": (0, 1), "camera": (0, 1)}
    free = tuple(dict.fromkeys(axes.get(name, (0, 1, 2, 3)), Dim.AUTO) for name in names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            torch.export.export(graph, inputs, dynamic_shapes=(free,), strict=False),
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
    # the part of onnxruntime's documented schema that is used here
    *inputs, output = (OpSchema.FormalParameter(name, "T") for name in ("query", "key", "value", "output"))
    attributes = [OpSchema.Attribute("num_heads", OpSchema.AttrType.INT, "")]
    kinds = {"type_constraints": [("T", ["tensor(float)"], "")], "attributes": attributes}
    schema = OpSchema("MultiHeadAttention", "com.microsoft", 1, inputs=inputs, outputs=[output], **kinds)
    attend = Op(Opset(schema.domain, 1), schema.name, schema)
    heads = int(query.shape[1])
    turned = [op.Transpose(each, perm=[0, 2, 1, 3]) for each in (query, key, value)]
    joined = [op.Reshape(each, op.Constant(value_ints=[0, 0, -1])) for each in turned]  # [B, N, heads * head_dim]
    out = op.Reshape(attend(*joined, num_heads=heads), op.Constant(value_ints=[0, 0, heads, -1]))
    return op.Transpose(out, perm=[0, 2, 1, 3])


def relative_difference(found: Tensor, expected: Tensor) -> float:
    """Returns max|found - expected| / max|expected|; infinity if the shapes differ or a value is NaN."""
    if found.shape != expected.shape or found.isnan().any():
        return float("inf")
    return float((found - expected).abs().max() / expected.abs().max())


class OnnxBackend(Backend):
    """Network exported by ``vg2gt export``.

    Name, licence and identity are those of the exported network, so both accept the same checkpoints. The encoder runs
    on the GPU if onnxruntime has the CUDA provider.

    Args:
        path: folder of the bundle.
        head_chunk: maximum number of views that the decoder decodes at a time; None decodes all at once.

    Raises:
        FileNotFoundError: if ``path`` is not a bundle or lacks a file.
        ValueError: if a file is damaged or does not fit.
    """

    def __init__(self, path: str | None = None, head_chunk: int | None = 8) -> None:
        if path is None:
            raise ValueError(f"backend=onnx needs backend.path=FOLDER: {_REMEDY}")
        folder = Path(path).expanduser()
        found = _read_description(folder)
        dims = tuple(found["token_dims"])
        super().__init__(found["name"], found["patch_size"], dims, found["licence"], needs_hints=found["needs_hints"])
        self._identity = {"name": found["name"], "weights": found["weights"]}
        self.head_chunk = head_chunk
        self.encoder_session = open_session(folder / ENCODER)
        self.decoder = _load_decoder(folder, found["decoder"])
        print(f"{self.name}: ONNX bundle {folder}, licence: {self.licence}")
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; ``hints.cameras`` are used if the exported network takes given poses."""
        self.check_images(images)
        inputs = {"images": images}
        if self.needs_hints:
            cameras = self.require_hints(images, hints, "cameras").cameras
            assert cameras is not None
            inputs |= {"world_to_camera": cameras.world_to_camera, "intrinsics": cameras.intrinsics}
        *patch, camera = _run_session(self.encoder_session, inputs, token_names(len(self.token_dims)))
        return self.as_tokens(images, [tap.flatten(2, 3) for tap in patch], camera)

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`."""
        return self.decoder.decode(tokens, self.head_chunk)

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        return self.decoder.decode_cameras(tokens)


def token_names(taps: int) -> list[str]:
    """Returns the names of the graphs' tokens: the patch tokens of every tap, and the camera token."""
    return [*(f"patch_{index}" for index in range(taps)), "camera"]


def _read_description(folder: Path) -> dict[str, Any]:
    """Reads ``backend.json`` of a bundle.

    Raises:
        FileNotFoundError: if one of the files that :class:`OnnxBackend` reads is missing.
        ValueError: if the description is not valid.
    """
    for name in (DESCRIPTION, ENCODER, DECODER_WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder} is not an ONNX bundle, {name} is missing: copy all of it, or {_REMEDY}")
    content = read_json(folder / DESCRIPTION)
    missing = [name for name in FIELDS if not isinstance(content, dict) or name not in content]
    if missing:
        raise ValueError(f"{folder / DESCRIPTION} does not describe a bundle, {missing[0]} is missing: {_REMEDY}")
    return content


def _load_decoder(folder: Path, decoder: Mapping[str, Any]) -> VGGTDecoder | DA3Decoder:
    """Rebuilds the decoder of a bundle from its ``class`` and ``arguments``.

    Raises:
        ValueError: if the class is unknown, or the arguments or weights do not fit.
    """
    try:
        with torch.device("meta"):
            module = _DECODERS[decoder["class"]](**decoder["arguments"])
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        known = " or ".join(_DECODERS)
        raise ValueError(f"{folder / DESCRIPTION} does not describe a {known} ({error!r}): {_REMEDY}") from error
    load_strictly(module, read_tensors(folder / DECODER_WEIGHTS), "", (), str(folder / DECODER_WEIGHTS))
    return module


def open_session(file: Path) -> onnxruntime.InferenceSession:
    """Opens an ONNX file on this process's GPU if onnxruntime can use it, else on the CPU with torch's threads.

    Raises:
        ValueError: if onnxruntime cannot open the file.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    providers: list[str | tuple[str, dict[str, str]]] = ["CPUExecutionProvider"]
    if CUDA in onnxruntime.get_available_providers():
        # Plain float32 as in torch, not TF32. In distributed training, every process has its own GPU.
        providers.insert(0, (CUDA, {"device_id": os.environ.get("LOCAL_RANK", "0"), "use_tf32": "0"}))
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=providers)
    except Exception as error:  # onnxruntime's own classes have no common base
        raise ValueError(f"onnxruntime {onnxruntime.__version__} cannot open {file} ({error}): {_REMEDY}") from error


def _run_session(
    session: onnxruntime.InferenceSession, inputs: Mapping[str, Tensor], outputs: Sequence[str]
) -> list[Tensor]:
    """Runs a session on tensors cast to float32; returns the named outputs on the inputs' device, without gradient."""
    device = next(iter(inputs.values())).device
    feeds = {name: value.detach().float().cpu().contiguous().numpy() for name, value in inputs.items()}
    return [torch.from_numpy(value).to(device) for value in session.run(list(outputs), feeds)]
