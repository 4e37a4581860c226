"""Trains the plane sweep: ``python -m recipes.sweep [key=value ...]``; options in ``train.yaml``.

Training has no planned end: the rate is constant, and the weights to use are a moving average. It continues from
``OUT/state.safetensors`` if that exists, else from ``begin``. With ``cooldown`` steps the rate falls to zero, all is
written to ``OUT/cooled``, and a fall that was stopped continues there.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from pathlib import Path
from typing import Any

# oneDNN compiles convolutions per shape; its default cache of 1024 is too small for one step of each shape.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "20000")

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor
from torch.utils.data import DataLoader

from backends.sweep.network import PosedViews, SweepNet
from recipes.sweep.objective import objective
from recipes.sweep.samples import Sample, TrainingSamples
from recipes.sweep.scenes import scene_files
from vg2gt.io.files import write_bytes

_LARGEST_GRADIENT = 1.0
_AVERAGED = "averaged."
_PLACES = ("out", "begin")  # folders of one machine, which do not belong in its files
STATE, WEIGHTS = "state.safetensors", "sweep.safetensors"


class Training:
    """The network, the moving average of its weights, the optimizer, and how far training has come.

    Args:
        options: ``training`` in ``train.yaml``.
        state: file to continue from; None for random weights.
        device: device of the network.
    """

    def __init__(self, options: DictConfig, state: Path | None = None, device: str = "cpu") -> None:
        self.options, self.step, self.seconds, self.here = options, 0, 0.0, 0
        self.fallen = 0  # steps of a falling rate
        self.device = torch.device(device)
        self.net: Any = SweepNet().to(self.device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.averaged = {name: value.detach().clone().float() for name, value in self.net.state_dict().items()}
        if state:
            metadata = _header(state)
            self.step, self.seconds = int(metadata.get("step", 0)), float(metadata.get("seconds", 0))
            self.fallen = int(metadata.get("fallen", 0))
            tensors = load_file(state, device)
            own = {name: value for name, value in tensors.items() if not name.startswith(_AVERAGED)}
            self.net.load_state_dict(own)
            self.averaged = {name: tensors.get(_AVERAGED + name, own[name]).float() for name in own}
        decayed = [p for p in self.net.parameters() if p.dim() > 1]
        rest = [p for p in self.net.parameters() if p.dim() <= 1]
        groups = [{"params": decayed, "weight_decay": options.weight_decay}, {"params": rest, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=options.rate, betas=(0.9, 0.98), fused=True)

    def update(self, sample: Sample, factor: float = 1.0) -> dict[str, float]:
        """One step on one sample, with ``factor`` on the rate; returns the terms of the objective.

        Raises:
            RuntimeError: if the objective or a gradient is not finite.
        """
        start = time.process_time()
        sample = Sample(*(value.to(self.device) for value in sample))
        for group in self.optimizer.param_groups:
            # the optimizer remembers some 50 steps: its state is not kept, but found again while the rate rises
            group["lr"] = self.options.rate * factor * min(1.0, (self.here + 1) / self.options.warmup)
        images = sample.images.contiguous(memory_format=torch.channels_last)
        views = PosedViews(images, sample.world_to_camera, sample.intrinsics)
        encoding = self.net.encode(self.net.features(images), views, sample.sources, sample.shown)
        taps: tuple[Tensor, ...] = encoding.taps
        if self.options.token_noise and self.step % 2:
            noise = torch.Generator().manual_seed(self.step)
            drawn = (torch.randn(tap.shape, generator=noise).to(tap) for tap in taps)
            taps = tuple(tap + self.options.token_noise * change for tap, change in zip(taps, drawn, strict=True))
        state = (encoding.context, encoding.context_fine, encoding.swept, encoding.origin)
        depth, log_scale = self.net.head(taps, *state)
        loss, terms = objective(encoding, depth, log_scale, sample)
        if not torch.isfinite(loss):
            raise RuntimeError(f"the objective is {float(loss)} at step {self.step}: {terms}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), _LARGEST_GRADIENT, error_if_nonfinite=True)
        self.optimizer.step()
        # shorter at the beginning, so that the first weights are forgotten
        keep = min(self.options.average, (self.step + 1) / (self.step + 5))
        for name, value in self.net.state_dict().items():
            self.averaged[name].lerp_(value.float(), 1 - keep)
        self.step, self.here = self.step + 1, self.here + 1
        self.seconds += time.process_time() - start
        return {"loss": float(loss.detach())} | {name: float(term.detach()) for name, term in terms.items()}

    def write(self, out: Path, config: DictConfig) -> None:
        """Writes the averaged weights, and what training continues from, in half precision."""
        options = {name: value for name, value in config.items() if name not in _PLACES}
        made_of = {"step": str(self.step), "seconds": f"{self.seconds:.0f}", "options": OmegaConf.to_yaml(options)}
        averaged = {name: value.half().contiguous() for name, value in self.averaged.items()}
        write_bytes(out / WEIGHTS, save(averaged, metadata=made_of))
        own = {name: value.detach().half().contiguous() for name, value in self.net.state_dict().items()}
        own |= {_AVERAGED + name: value for name, value in averaged.items()}
        write_bytes(out / STATE, save(own, metadata=made_of | {"fallen": str(self.fallen)}))


def _header(file: Path) -> dict[str, str]:
    with safe_open(file, "pt") as opened:
        return opened.metadata() or {}


def begun_with(config: DictConfig) -> tuple[Path, Path | None]:
    """Returns the folder to write to, and the state to continue from; None: random weights.

    Raises:
        FileNotFoundError: if ``begin`` does not exist, or there is no state from which the rate could fall.
        ValueError: if the fall in the folder is over, or began from another state than the one that is there.
    """
    base, begin = Path(config.out) / STATE, Path(config.begin) if config.begin else None
    known = next((file for file in (base, begin) if file and file.is_file()), None)
    if begin and known is None:
        raise FileNotFoundError(f"begin={begin} does not exist")
    if not config.cooldown:
        return base.parent, known
    out = base.parent / "cooled"
    if (out / STATE).is_file():
        header = _header(out / STATE)
        fallen = int(header["fallen"])
        if fallen >= config.cooldown:
            raise ValueError(f"{out} holds a fall of {fallen} steps, which is over: move it away")
        first = int(header["step"]) - fallen
        if known and int(_header(known).get("step", 0)) != first:
            raise ValueError(f"{out} holds a fall from step {first}, not from {known}: move it away")
        return out, out / STATE
    if known is None:
        raise FileNotFoundError(f"{base} does not exist: give a state from which the rate falls, begin=FILE")
    return out, known


@hydra.main(config_path=".", config_name="train", version_base="1.3")
def main(config: DictConfig) -> None:
    """Trains for ``minutes``, for ``cooldown`` steps, or until the process is told to stop."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    out, begun = begun_with(config)
    out.mkdir(parents=True, exist_ok=True)
    training = Training(config.training, begun, config.device)
    training.fallen = training.fallen if begun == out / STATE else 0  # another fall may have made what this begins with
    files = [file for part in config.scenes.parts for file in scene_files(config.scenes.folder, **part)]
    files = [file for file in files if file.is_file()] if config.scenes.rendered else files
    if not files:
        raise FileNotFoundError(f"{config.scenes.folder} has no rendered scene: set scenes.rendered=false")
    rooms = sorted(Path(config.infinigen.folder).glob("room_*.npz")) if config.infinigen.folder else []
    samples = TrainingSamples(files, config.seed, rooms, config.infinigen.share, **config.samples)
    print(f"step {training.step}, {len(files)} scenes, {len(rooms)} rooms, begun with {begun}", flush=True)
    told: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *given: told.append(given[0]))
    start = written = time.monotonic()
    mean: dict[str, float] = {}
    first = training.step
    for sample in DataLoader(samples, batch_size=None, sampler=itertools.count(first), num_workers=config.workers):
        factor = 1.0 - training.fallen / config.cooldown if config.cooldown else 1.0
        terms = training.update(sample, factor)
        training.fallen += bool(config.cooldown)
        mean = {name: mean.get(name, term) + 0.02 * (term - mean.get(name, term)) for name, term in terms.items()}
        if training.step % 50 == 0:
            shown = " ".join(f"{name} {value:.4f}" for name, value in mean.items())
            rate = (time.monotonic() - start) / (training.step - first)
            print(f"{training.step} {rate:.2f} s/step {training.seconds / 3600:.2f} h {shown}", flush=True)
        over = bool(config.cooldown) and training.fallen == config.cooldown
        if told or over or (config.minutes and time.monotonic() - start > 60 * config.minutes):
            break
        if time.monotonic() - written > 60 * config.save_minutes:
            training.write(out, config)
            written = time.monotonic()
    training.write(out, config)


if __name__ == "__main__":
    main()
