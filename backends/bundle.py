"""The ONNX bundle: a folder with a frozen network cut into encoder and decoder, described by ``backend.json``.

``encoder.onnx``, ``decoder.onnx`` and ``decoder.safetensors``, with the sha256 of each file in the description. The
decoder's weights come with the name and the numbers of its class, so that it can be rebuilt as a torch module.
"""

from __future__ import annotations

import hashlib
import json
import mmap
from collections.abc import Iterator, Mapping
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
REMEDY = "write it with vg2gt export backend=NAME out=FOLDER"

Decoder = VGGTDecoder | DA3Decoder
DECODERS: dict[str, type[VGGTDecoder] | type[DA3Decoder]] = {
    kind.__name__: kind for kind in (VGGTDecoder, DA3Decoder)
}  # nothing else is ever built from a file

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
    """What ``backend.json`` says.

    Attributes:
        name: of the exported backend.
        licence: of its weights.
        weights: sha256 of its weights (``Backend.identity``), so that checkpoints know the network again.
        patch_size: in pixels.
        token_dims: channels of the patch tokens, in tap order.
        taps: the tapped layers.
        needs_hints: whether the encoder also takes ``world_to_camera`` and ``intrinsics``.
        decoder: ``class`` and ``arguments`` of the decoder, for its weights.
        conventions: of the arrays, for readers.
        max_difference: largest relative difference to torch when written, ``encoder`` and ``decoder``.
        files: sha256 of every other file.
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
    files: dict[str, str]
    format: int = FORMAT

    def write(self, folder: Path) -> None:
        """Writes the description into a folder."""
        (folder / DESCRIPTION).write_text(json.dumps(asdict(self), indent=2) + "\n")


def read_bundle(folder: Path) -> Description:
    """Reads a bundle's description and checks every file against it.

    Only the decoder's weights may be missing.

    Raises:
        FileNotFoundError: naming what is missing.
        ValueError: if the description is not one, a file differs, or data lies outside the folder.
    """
    file = folder / DESCRIPTION
    if not file.is_file():
        raise FileNotFoundError(f"{folder} is no ONNX bundle, it has no {DESCRIPTION}: {REMEDY}")
    description = _parse(file)
    for name, expected in {ENCODER: "", DECODER: "", **description.files}.items():
        if Path(name).name != name:
            raise ValueError(f"{file} names {name!r}, which is not a file of the folder itself: {REMEDY}")
        if not (folder / name).is_file():
            if name == DECODER_WEIGHTS:
                continue
            raise FileNotFoundError(f"{folder} has no {name}: copy the whole folder, or {REMEDY}")
        if (folder / name).resolve().parent != folder.resolve():
            raise ValueError(
                f"{folder / name} is a link to a file outside the folder: copy the file itself, or {REMEDY}"
            )
        found = sha256(folder / name)
        if found != expected:
            raise ValueError(
                f"{folder / name} is damaged or not of this bundle: sha256 {found}, {DESCRIPTION} says "
                f"{expected or 'nothing'}. Copy the whole folder again, or {REMEDY}"
            )
    for name in (ENCODER, DECODER):
        strangers = sorted(set(external_data(folder / name)) - set(description.files))
        if strangers:
            raise ValueError(f"{folder / name} reads data outside the bundle ({', '.join(strangers)}): {REMEDY}")
    return description


def _parse(file: Path) -> Description:
    try:
        content = json.loads(file.read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not valid JSON ({error}): {REMEDY}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{file} is not a description of format {FORMAT}: {REMEDY}")
    names = {field.name for field in fields(Description)}
    if set(content) != names:
        raise ValueError(f"{file} lacks or adds {', '.join(sorted(names ^ set(content)))}: {REMEDY}")
    for field in fields(Description):
        kind = str(field.type).split("[")[0]
        if type(content[field.name]).__name__ != kind:
            raise ValueError(f"{file} has {field.name}={content[field.name]!r}, expected {kind}: {REMEDY}")
    return Description(**content)


def sha256(file: Path) -> str:
    """Hexadecimal digest of a file of any size."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def load_decoder(folder: Path, decoder: Mapping[str, Any]) -> Decoder | None:
    """Rebuilds the decoder with its weights; None where the folder has none.

    Raises:
        ValueError: if the class is not one of :data:`DECODERS`, or arguments or weights do not fit it.
    """
    file = folder / DECODER_WEIGHTS
    if not file.is_file():
        return None
    kind = DECODERS.get(str(decoder.get("class")))
    if kind is None:
        raise ValueError(
            f"{folder / DESCRIPTION} names the decoder {decoder.get('class')!r}; known are {', '.join(DECODERS)}. "
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
    """Which of :data:`DECODERS` a network is built on."""
    return next(kind for kind in DECODERS.values() if isinstance(network, kind))


def decoder_weights(network: Decoder) -> dict[str, Tensor]:
    """The part of a network's state that its decoder class has."""
    with torch.device("meta"):
        names = decoder_class(network)(**network.arguments).state_dict()
    state = network.state_dict()
    return {name: state[name].detach().cpu().contiguous() for name in names}


# Protocol buffer fields of an ONNX model that lead to tensors: message -> field number -> message.
_LEADS_TO = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 10: "tensor", 6: "graph", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "entry"},
}
_KEY, _VALUE = 1, 2


def external_data(file: Path) -> list[str]:
    """Names of the files outside an ONNX file that its tensors lie in, as they stand there.

    Raises:
        ValueError: if it is not an ONNX file.
    """
    try:
        with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return sorted(set(_locations(content, 0, len(content), "model")))
    except (IndexError, ValueError, RecursionError) as error:  # ValueError: an empty file, or names that are no text
        raise ValueError(f"{file} is not an ONNX file: {REMEDY}") from error


def _locations(content: mmap.mmap, start: int, end: int, message: str) -> Iterator[str]:
    for number, begin, stop in _fields(content, start, end):
        inner = _LEADS_TO[message].get(number)
        if inner == "entry":
            pair = {field: content[a:b].decode() for field, a, b in _fields(content, begin, stop)}
            if pair.get(_KEY) == "location":
                yield pair.get(_VALUE, "")
        elif inner is not None:
            yield from _locations(content, begin, stop, inner)


def _fields(content: mmap.mmap, position: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yields number, begin and end of the length-delimited fields of a message."""
    while position < end:
        tag, position = _varint(content, position)
        kind = tag & 7
        if kind == 2:
            length, position = _varint(content, position)
            if position + length > end:
                raise IndexError(position)
            yield tag >> 3, position, position + length
            position += length
        elif kind == 0:
            _, position = _varint(content, position)
        elif kind in (1, 5):
            position += 8 if kind == 1 else 4
        else:
            raise IndexError(position)


def _varint(content: mmap.mmap, position: int) -> tuple[int, int]:
    value, shift = 0, 0
    while True:
        byte = content[position]
        value |= (byte & 127) << shift
        position, shift = position + 1, shift + 7
        if byte < 128:
            return value, position
