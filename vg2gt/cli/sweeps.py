"""Jobs of a sweep that train on several devices."""

from __future__ import annotations

import os
import subprocess
import sys

from hydra.core.hydra_config import HydraConfig
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from omegaconf import DictConfig

from vg2gt.cli.errors import in_a_sweep


def needs_own_process(config: DictConfig) -> bool:
    """Whether a sweep's job would start ranks itself.

    Ranks are started by repeating the command line, here the whole sweep, and their process group lives as long as the
    process: the next job would inherit both.
    """
    started_by_others = "LOCAL_RANK" in os.environ or SLURMEnvironment.detect() or TorchElasticEnvironment.detect()
    return in_a_sweep() and str(config.trainer.devices) != "1" and not started_by_others


def run_in_own_process(config: DictConfig) -> None:
    """Runs the sweep's present job as a command of its own.

    Raises:
        RuntimeError: if it ends with an error.
    """
    overrides = HydraConfig.get().overrides
    hydra = [override for override in overrides.hydra if not override.startswith("hydra.mode=")]
    spec = sys.modules["__main__"].__spec__
    program = ["-m", spec.name] if spec else [os.path.abspath(sys.argv[0])]
    folder = f'hydra.run.dir="{config.output_dir}"'
    ended = subprocess.run([sys.executable, *program, *hydra, *overrides.task, folder], check=False)
    if ended.returncode:
        raise RuntimeError(f"{config.output_dir}: the job ended with status {ended.returncode}, its error is above")
