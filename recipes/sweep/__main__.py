"""Trains the plane sweep: ``python -m recipes.sweep [key=value ...]``; options in ``train.yaml``."""

from __future__ import annotations

import os
from pathlib import Path

# oneDNN compiles convolutions per shape; its default cache of 1024 is too small for one step of each shape.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "20000")

import hydra
import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import DictConfig
from torch.utils.data import DataLoader, Subset

from recipes.sweep.module import SweepTraining
from recipes.sweep.samples import TrainingSamples
from recipes.sweep.scenes import make_scenes, read_infinigen


@hydra.main(config_path=".", config_name="train", version_base="1.3")
def main(config: DictConfig) -> None:
    """Renders missing scenes, trains or resumes training, and writes the weights."""
    torch.set_num_threads(config.threads)
    lightning.seed_everything(config.seed)
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    files, scenes = [], config.scenes
    made = make_scenes(scenes.folder, scenes.count, scenes.first_seed, tuple(scenes.size), scenes.workers)
    for number, path in enumerate(made, 1):
        files.append(path)
        if number % 50 == 0 or number == scenes.count:
            print(f"scenes: {number} of {scenes.count}", flush=True)
    newest = max(out.glob("*.ckpt"), key=lambda path: path.stat().st_mtime, default=None)
    checkpoint = newest if config.resume == "auto" else config.resume
    training: SweepTraining = hydra.utils.instantiate(config.training)
    first = torch.load(checkpoint, "cpu", weights_only=True, mmap=True)["global_step"] if checkpoint else 0
    rooms = read_infinigen(config.infinigen.folder, config.scenes.folder) if config.infinigen.folder else []
    count = training.steps * config.processes
    every = TrainingSamples(files, count, config.seed, rooms, config.infinigen.share, **config.samples)
    samples = Subset(every, range(first * config.processes, len(every)))
    if config.begin and not checkpoint:
        training.begin_with(Path(config.begin))
    if checkpoint:
        print(f"resuming {checkpoint} at step {first} of {training.steps}", flush=True)
    keep = ModelCheckpoint(
        out, "step-{step:06d}", every_n_train_steps=config.save_every, save_top_k=-1, auto_insert_metric_name=False
    )
    trainer = lightning.Trainer(
        accelerator=config.accelerator,
        devices=config.processes,
        strategy="auto" if config.processes == 1 else DDPStrategy(gradient_as_bucket_view=True),
        precision="bf16-mixed",
        max_steps=training.steps,
        callbacks=[keep, RichProgressBar()],
        logger=CSVLogger(out, name="", version=""),
        log_every_n_steps=50,
        enable_model_summary=False,
    )
    workers = {"num_workers": config.workers, "pin_memory": config.accelerator == "gpu"}
    trainer.fit(training, DataLoader(samples, batch_size=None, **workers), ckpt_path=checkpoint, weights_only=True)
    if trainer.is_global_zero:
        print(training.write_weights(out / "sweep.safetensors", config, len(rooms)))


if __name__ == "__main__":
    main()
