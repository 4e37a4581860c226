"""Trains the plane sweep: ``python -m recipes.sweep [key=value ...]``; options in ``train.yaml``."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

# oneDNN compiles convolutions per shape; its default cache of 1024 is too small for one step of each shape.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "20000")

import hydra
import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import DictConfig
from safetensors.torch import load_file, save
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Subset

from backends.sweep.network import PosedViews, SweepNet
from recipes.sweep.objective import objective
from recipes.sweep.samples import Sample, TrainingSamples
from recipes.sweep.scenes import read_infinigen, scene_files
from vg2gt.geometry.precision import full_precision
from vg2gt.io.files import write_bytes

_LARGEST_GRADIENT = 1.0


class SweepTraining(lightning.LightningModule):
    """Trains the network; the shipped weights are an exponential moving average of the trained weights.

    The learning rate is warmed up linearly, stays constant, and decays to 2 % by a half cosine at the end. A checkpoint
    from before the decay can resume with more ``steps``, as if they had been configured from the start.

    Args:
        options: ``training`` in ``train.yaml``.
    """

    def __init__(self, options: DictConfig) -> None:
        super().__init__()
        self.options = options
        self.net = SweepNet()
        self.net.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.averaged = AveragedModel(self.net, multi_avg_fn=get_ema_multi_avg_fn(options.average))
        self.averaged.requires_grad_(False)

    def training_step(self, sample: Sample, index: int) -> Tensor:
        """Returns the objective of one sample; raises RuntimeError if it is not finite."""
        images = sample.images.contiguous(memory_format=torch.channels_last)
        views = PosedViews(images, sample.world_to_camera, sample.intrinsics, sample.scenes)
        encoding = self.net.encode(self.net.features(images), views, sample.depth_range, sample.sources, sample.planes)
        taps = encoding.taps
        if self.options.token_noise and self.global_step % 2:
            taps = tuple(tap + self.options.token_noise * torch.randn_like(tap) for tap in taps)
        depth, log_scale = self.net.head(taps, encoding.context, encoding.context_fine, encoding.swept)
        with full_precision(depth):
            loss, terms = objective(encoding, depth, log_scale, sample)
        if not torch.isfinite(loss):
            raise RuntimeError(f"the objective is {float(loss)} at step {self.global_step}: {terms}")
        self.log_dict({f"train/{name}": term.detach() for name, term in terms.items()} | {"train/loss": loss.detach()})
        return loss

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Clips the gradient norm, as Lightning cannot with a fused optimizer; raises RuntimeError if not finite."""
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), _LARGEST_GRADIENT, error_if_nonfinite=True)
        self.log("train/gradient_norm", norm)

    def on_train_batch_end(self, *_: Any) -> None:
        """Updates the exponential moving average."""
        self.averaged.update_parameters(self.net)

    def configure_optimizers(self) -> Any:
        """Returns AdamW and the learning-rate schedule of the class docstring."""
        decayed = [p for p in self.net.parameters() if p.dim() > 1]
        rest = [p for p in self.net.parameters() if p.dim() <= 1]
        groups = [{"params": decayed, "weight_decay": self.options.weight_decay}, {"params": rest, "weight_decay": 0.0}]
        optimizer = torch.optim.AdamW(groups, lr=self.options.rate, betas=(0.9, 0.98), fused=True)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._relative_rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _relative_rate(self, step: int) -> float:
        steps = self.options.steps
        begin = (1 - self.options.cooldown) * steps
        fall = min(max((step - begin) / max(steps - begin, 1), 0.0), 1.0)
        return min(1.0, (step + 1) / self.options.warmup) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * fall)))


def write_weights(training: SweepTraining, path: Path, config: DictConfig, rooms: int) -> None:
    """Writes the averaged weights in half precision, with a summary of the training in the header.

    Args:
        training: the trained module.
        path: output safetensors file.
        config: configuration of the training.
        rooms: number of Infinigen rooms among its scenes.
    """
    state = training.averaged.module.state_dict()
    tensors = {name: value.detach().half().contiguous() for name, value in sorted(state.items())}
    made_of = {
        "steps": str(training.global_step),
        "scenes": f"{config.scenes.count} from seed {config.scenes.first_seed}, {rooms} Infinigen rooms",
        "seed": str(config.seed),
        "begun_with": Path(config.begin).name if config.begin else "random weights",
        "device": torch.cuda.get_device_name() if config.accelerator == "gpu" else "cpu",
    }
    print(write_bytes(path, save(tensors, metadata=made_of)))


@hydra.main(config_path=".", config_name="train", version_base="1.3")
def main(config: DictConfig) -> None:
    """Trains or resumes training, and writes the weights."""
    torch.set_num_threads(config.threads)
    lightning.seed_everything(config.seed)
    out = Path(config.out)
    newest = max(out.glob("*.ckpt"), key=lambda path: path.stat().st_mtime, default=None)
    checkpoint = newest if config.resume == "auto" else config.resume
    training = SweepTraining(config.training)
    first = torch.load(checkpoint, "cpu", weights_only=True, mmap=True)["global_step"] if checkpoint else 0
    files = scene_files(**config.scenes)
    rooms = read_infinigen(config.infinigen.folder, config.scenes.folder) if config.infinigen.folder else []
    count = config.training.steps * config.processes
    every = TrainingSamples(files, count, config.seed, rooms, config.infinigen.share, **config.samples)
    # all of them, from the next one on: Lightning counts those before a checkpoint as read
    samples = Subset(every, [(first * config.processes + i) % count for i in range(count)])
    if config.begin and not checkpoint:
        for net in (training.net, training.averaged.module):
            net.load_state_dict(load_file(config.begin))
    if checkpoint:
        print(f"resuming {checkpoint} at step {first} of {config.training.steps}", flush=True)
    keep = ModelCheckpoint(
        out, "step-{step:06d}", every_n_train_steps=config.save_every, save_top_k=-1, auto_insert_metric_name=False
    )
    trainer = lightning.Trainer(
        accelerator=config.accelerator,
        devices=config.processes,
        strategy="auto" if config.processes == 1 else DDPStrategy(gradient_as_bucket_view=True),
        precision=config.precision,
        max_steps=config.training.steps,
        callbacks=[keep, RichProgressBar()],
        logger=CSVLogger(out, name="", version=""),
        log_every_n_steps=50,
        enable_model_summary=False,
    )
    workers = {"num_workers": config.workers, "pin_memory": config.accelerator == "gpu"}
    trainer.fit(training, DataLoader(samples, batch_size=None, **workers), ckpt_path=checkpoint, weights_only=True)
    if trainer.is_global_zero:
        write_weights(training, out / "sweep.safetensors", config, len(rooms))


if __name__ == "__main__":
    main()
