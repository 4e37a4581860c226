"""ONNX bundle: a folder with a frozen network split into encoder and decoder, described by ``backend.json``.

The description holds the class and the arguments of the decoder, so that it can be rebuilt as a torch module.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from backends.da3.backend import DA3Decoder
from backends.vggt.network import VGGTDecoder
from backends.weights import load_strictly
from vg2gt.io.tensors import read_tensors

DESCRIPTION = "backend.json"
ENCODER, DECODER, DECODER_WEIGHTS = "encoder.onnx", "decoder.onnx", "decoder.safetensors"
FORMAT = 1
REMEDY = "write it with vg2gt export backend=NAME --out FOLDER"

Decoder = VGGTDecoder | DA3Decoder
DECODERS: dict[str, type[VGGTDecoder] | type[DA3Decoder]] = {
    kind.__name__: kind for kind in (VGGTDecoder, DA3Decoder)
}  # the only classes that are built from a file

CONVENTIONS = {
    "images": "float32 [B, V, 3, H, W] in [0, 1]; H and W multiples of patch_size; B, V, H, W free",
    "patch_i": "float32 [B, V, h, w, D]: patch tokens of tap i, h = H / patch_size rows, w = W / patch_size columns",
    "camera": "float32 [B, V, Dc]",
    "depth": "float32 [B, V, H, W]: z-depth in the unit of the cameras' translations",
    "depth_conf": "float32 [B, V, H, W]: > 0, larger is better",
    "world_to_camera": "float32 [B, V, 4, 4]: OpenCV, x right, y down, z forward",
    "intrinsics": "float32 [B, V, 3, 3] in pixels, integer pixel centres, principal point (W / 2, H / 2)",
}


@dataclass(frozen=True)
class Description:
    """Content of ``backend.json``.

    Attributes:
        name: name of the exported backend.
        licence: licence of its weights.
        weights: sha256 of its weights (``Backend.identity``), which checkpoints are matched with.
        patch_size: edge of a patch in pixels.
        token_dims: channels of the patch tokens, in tap order.
        taps: indices of the tapped layers.
        needs_hints: whether the encoder also takes ``world_to_camera`` and ``intrinsics``.
        decoder: ``class`` and ``arguments`` to rebuild the decoder.
        conventions: human-readable description of the arrays.
        max_difference: largest relative difference to torch at export, of ``encoder`` and ``decoder``.
        format: version of this description.
    """

    name: str
    licence: str
    weights: str
    patch_size: int
    token_dims: list[int]
    taps: list[int]
    needs_hints: bool
    decoder: dict[str, Any]
    conventions: dict[str, str]
    max_difference: dict[str, float]
    format: int = FORMAT

    def write(self, folder: Path) -> None:
        """Writes the description into a folder."""
        (folder / DESCRIPTION).write_text(json.dumps(asdict(self), indent=2) + "\n")


def read_bundle(folder: Path) -> Description:
    """Reads the description of a bundle; only the decoder's weights may be missing from the folder.

    Raises:
        FileNotFoundError: if another file is missing.
        ValueError: if the description is not valid.
    """
    for name in (DESCRIPTION, ENCODER, DECODER):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder} is not an ONNX bundle, {name} is missing: copy the whole folder, or {REMEDY}"
            )
    file = folder / DESCRIPTION
    try:
        content = json.loads(file.read_text())
        description = Description(**{field.name: content[field.name] for field in fields(Description)})
    except (ValueError, RecursionError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is not the description of a bundle ({error!r}): {REMEDY}") from error
    if description.format != FORMAT:
        raise ValueError(f"{file} is not a description of format {FORMAT}: {REMEDY}")
    return description


def load_decoder(folder: Path, decoder: Mapping[str, Any]) -> Decoder | None:
    """Rebuilds the decoder with its weights; returns None if the folder has no weights.

    Args:
        folder: folder of the bundle.
        decoder: ``class`` and ``arguments`` from the description.

    Raises:
        ValueError: if the class is not one of :data:`DECODERS`, or the arguments or weights do not fit.
    """
    file = folder / DECODER_WEIGHTS
    if not file.is_file():
        return None
    kind = DECODERS.get(str(decoder.get("class")))
    if kind is None:
        raise ValueError(
            f"{folder / DESCRIPTION} names the unknown decoder {decoder.get('class')!r}, not {' or '.join(DECODERS)}. "
            f"Remove {DECODER_WEIGHTS} to decode without gradient, or {REMEDY}"
        )
    try:
        with torch.device("meta"):
            module = kind(**decoder.get("arguments", {}))
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{folder / DESCRIPTION} has wrong arguments for {kind.__name__} ({error}): {REMEDY}"
        ) from error
    load_strictly(module, read_tensors(file), "", (), str(file))
    return module


def decoder_class(network: Decoder) -> type[VGGTDecoder] | type[DA3Decoder]:
    """Returns the class in :data:`DECODERS` that a network is an instance of."""
    return next(kind for kind in DECODERS.values() if isinstance(network, kind))


def decoder_weights(network: Decoder) -> dict[str, Tensor]:
    """Returns the decoder's part of a network's state."""
    with torch.device("meta"):
        names = decoder_class(network)(**network.arguments).state_dict()
    state = network.state_dict()
    return {name: state[name].detach().cpu().contiguous() for name in names}
