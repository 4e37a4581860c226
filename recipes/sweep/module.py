"""Lightning module that trains the plane sweep."""

from __future__ import annotations

import math
import time
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from backends.sweep.network import PosedViews, SweepEncoding, SweepNet
from recipes.sweep.objective import objective
from recipes.sweep.samples import Sample
from vg2gt.geometry.precision import full_precision

_LARGEST_GRADIENT = 1.0


class SweepTraining(lightning.LightningModule):
    """Trains the network; the shipped weights are an exponential moving average of the trained weights.

    The learning rate is warmed up linearly, stays constant, and decays to 2 % by a half cosine at the end. A checkpoint
    from before the decay can resume with more ``steps``, as if they had been configured from the start.

    Args:
        steps: total number of steps.
        rate: learning rate of AdamW.
        weight_decay: weight decay of matrices and convolution kernels.
        warmup: steps of linear warm-up.
        cooldown: fraction of the steps over which the learning rate decays.
        average: decay of the exponential moving average.
        token_noise: standard deviation of the noise added to the tokens in every second step, which makes the decoded
            depth change smoothly with the tokens.
    """

    def __init__(
        self,
        steps: int = 20000,
        rate: float = 1e-3,
        weight_decay: float = 0.02,
        warmup: int = 100,
        cooldown: float = 0.3,
        average: float = 0.998,
        token_noise: float = 0.3,
    ) -> None:
        super().__init__()
        self.steps, self.rate, self.weight_decay = steps, rate, weight_decay
        self.warmup, self.cooldown, self.token_noise = warmup, cooldown, token_noise
        self.net = SweepNet()
        self.net.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.averaged = AveragedModel(self.net, multi_avg_fn=get_ema_multi_avg_fn(average))
        self.averaged.requires_grad_(False)
        self._core_seconds = 0.0  # of earlier processes, minus the time used by this one before training
        self._processes = 1

    def training_step(self, sample: Sample, index: int) -> Tensor:
        """Returns the objective of one sample; raises RuntimeError if it is not finite."""
        encoding, depth, log_scale = self._predict(sample)
        with full_precision(depth):
            loss, terms = objective(encoding, depth, log_scale, sample)
        if not torch.isfinite(loss):
            raise RuntimeError(f"the objective is {float(loss)} at step {self.global_step}: {terms}")
        self.log_dict({f"train/{name}": term.detach() for name, term in terms.items()} | {"train/loss": loss.detach()})
        return loss

    def _predict(self, sample: Sample) -> tuple[SweepEncoding, Tensor, Tensor]:
        images = sample.images.contiguous(memory_format=torch.channels_last)
        views = PosedViews(images, sample.world_to_camera, sample.intrinsics, sample.scenes)
        encoding = self.net.encode(self.net.features(images), views, sample.depth_range, sample.sources, sample.planes)
        taps = encoding.taps
        if self.token_noise and self.global_step % 2:
            taps = tuple(tap + self.token_noise * torch.randn_like(tap) for tap in taps)
        return encoding, *self.net.decode(taps, encoding.context, encoding.context_fine, encoding.swept)

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
        groups = [{"params": decayed, "weight_decay": self.weight_decay}, {"params": rest, "weight_decay": 0.0}]
        optimizer = torch.optim.AdamW(groups, lr=self.rate, betas=(0.9, 0.98), fused=True)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._relative_rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    @property
    def core_seconds(self) -> float:
        """CPU time of the whole training in seconds, over all processes and resumed runs."""
        return self._core_seconds + self._processes * time.process_time()

    def count_from(self, core_seconds: float) -> None:
        """Sets the CPU time that the initial weights have cost."""
        self._core_seconds = core_seconds

    def on_train_start(self) -> None:
        """Starts counting CPU time."""
        self._processes = self.trainer.world_size
        self._core_seconds -= self._processes * time.process_time()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Stores the CPU time."""
        checkpoint["core_seconds"] = self.core_seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restores the CPU time."""
        self._core_seconds = float(checkpoint.get("core_seconds", 0.0))

    def _relative_rate(self, step: int) -> float:
        begin = (1 - self.cooldown) * self.steps
        fall = min(max((step - begin) / max(self.steps - begin, 1), 0.0), 1.0)
        return min(1.0, (step + 1) / self.warmup) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * fall)))
