"""Backend from an ONNX bundle: the encoder runs in onnxruntime, the decoder is a differentiable torch module."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import onnxruntime
import torch
from torch import Tensor

from backends.base import Backend
from backends.bundle import DECODER, DECODER_WEIGHTS, ENCODER, REMEDY, load_decoder, read_bundle
from vg2gt.types import Cameras, Geometry, Hints, Tokens

Provider = Literal["auto", "cpu", "cuda"]
DECODED = ("depth", "depth_conf", "world_to_camera", "intrinsics")
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


class OnnxBackend(Backend):
    """Network exported by ``vg2gt export``.

    Name, licence and identity are those of the exported network, so both accept the same checkpoints. If the folder has
    no ``decoder.safetensors``, ``decode`` runs ``decoder.onnx`` and is not differentiable.

    Args:
        path: folder of the bundle.
        provider: where to run the encoder; ``auto`` uses the GPU if onnxruntime has the CUDA provider.
        head_chunk: maximum number of views that the torch decoder decodes at a time; None decodes all at once.

    Raises:
        FileNotFoundError: if ``path`` is not a bundle or lacks a file.
        ValueError: if a file is damaged or does not fit, or the provider is unknown.
        RuntimeError: if the provider is not available.
    """

    def __init__(self, path: str | None = None, provider: Provider = "auto", head_chunk: int | None = 8) -> None:
        if path is None:
            raise ValueError(f"backend=onnx needs backend.path=FOLDER: {REMEDY}")
        if provider not in get_args(Provider):
            raise ValueError(f"backend.provider is {provider!r}; choose one of {', '.join(get_args(Provider))}")
        folder = Path(path).expanduser()
        description = read_bundle(folder)
        decoder = load_decoder(folder, description.decoder)
        super().__init__(
            description.name,
            description.patch_size,
            tuple(description.token_dims),
            description.licence,
            supports_gradient=decoder is not None,
            needs_hints=description.needs_hints,
        )
        self._identity = {"name": description.name, "weights": description.weights}
        self.head_chunk = head_chunk
        self.decoder = decoder
        self.encoder_session = open_session(folder / ENCODER, provider)
        self.decoder_session = open_session(folder / DECODER, provider) if decoder is None else None
        if decoder is None:
            warnings.warn(
                f"{folder} has no {DECODER_WEIGHTS}: backend {self.name} decodes without gradient, so the coarse "
                "module is not trained through its depth",
                stacklevel=2,
            )
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
        names = [*(f"patch_{index}" for index in range(len(self.token_dims))), "camera"]
        *patch, camera = run_session(self.encoder_session, inputs, names)
        grid = (patch[0].shape[2], patch[0].shape[3])
        return Tokens(tuple(tap.flatten(2, 3) for tap in patch), camera, grid, (images.shape[-2], images.shape[-1]))

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`."""
        if self.decoder is not None:
            return self.decoder.decode(tokens, self.head_chunk)
        assert self.decoder_session is not None
        inputs = {f"patch_{index}": tap.unflatten(2, tokens.grid) for index, tap in enumerate(tokens.patch)}
        inputs |= {"camera": tokens.camera}
        depth, confidence, world_to_camera, intrinsics = run_session(self.decoder_session, inputs, DECODED)
        cameras = Cameras(world_to_camera, intrinsics, tokens.size)
        return Geometry(depth, confidence, cameras, torch.ones_like(depth[:, 0, 0, 0]))

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        return super().decode_cameras(tokens) if self.decoder is None else self.decoder.decode_cameras(tokens)


def open_session(file: Path, provider: Provider) -> onnxruntime.InferenceSession:
    """Opens an ONNX file on this process's GPU or on the CPU, with torch's number of threads.

    Raises:
        ValueError: if onnxruntime cannot open the file.
        RuntimeError: if ``provider`` is ``cuda`` and not available.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    providers: list[str | tuple[str, dict[str, str]]] = [CPU]
    if provider != "cpu" and CUDA in onnxruntime.get_available_providers():
        # Plain float32 as in torch, not TF32. In distributed training, every process has its own GPU.
        providers.insert(0, (CUDA, {"device_id": os.environ.get("LOCAL_RANK", "0"), "use_tf32": "0"}))
    try:
        session = onnxruntime.InferenceSession(str(file), options, providers=providers)
    except Exception as error:  # onnxruntime's own classes have no common base
        raise ValueError(f"onnxruntime {onnxruntime.__version__} cannot open {file} ({error}): {REMEDY}") from error
    if provider == "cuda" and CUDA not in session.get_providers():
        raise RuntimeError(
            f"backend.provider=cuda, but onnxruntime only has {', '.join(session.get_providers())}: install "
            "onnxruntime-gpu in place of onnxruntime, or use backend.provider=cpu"
        )
    return session


def run_session(
    session: onnxruntime.InferenceSession, inputs: Mapping[str, Tensor], outputs: Sequence[str]
) -> list[Tensor]:
    """Runs a session on tensors cast to float32; returns the named outputs on the inputs' device, without gradient."""
    device = next(iter(inputs.values())).device
    feeds = {name: value.detach().float().cpu().contiguous().numpy() for name, value in inputs.items()}
    return [torch.from_numpy(value).to(device) for value in session.run(list(outputs), feeds)]
