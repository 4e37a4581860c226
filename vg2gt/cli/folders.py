"""Names of run folders, as OmegaConf resolvers for the configurations of commands."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from omegaconf import DictConfig, OmegaConf

FIRST = "quickstart"
NAMING = {"data": "synthetic", "backend": "oracle", "model": "tiny"}  # a run with these defaults is named FIRST
ADDED = ("experiment", "ablation")
STARTED_BY_OTHERS = ("LOCAL_RANK", "RANK", "SLURM_PROCID")
OF_A_RUN = ("config.yaml", "checkpoints", ".lock")


def register() -> None:
    """Registers the resolvers ``${run_folder:}`` and ``${inside:NAME}`` with OmegaConf."""
    OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
    OmegaConf.register_new_resolver("inside", inside, replace=True)


def run_folder(_root_: DictConfig) -> str:
    """Returns a training's folder inside ``outputs``: ``name``, or one made of the chosen options.

    A name made of the options gets a number if it is taken, but not if a run is resumed (``ckpt=last``, ``auto``) or
    replaced (``overwrite=true``), or if several processes start at once. Sweeps are named ``sweep``. Trials
    (``fast_dev_run``) go to ``trials/``.
    """
    config = _root_
    sweep = str(config.hydra.mode).endswith("MULTIRUN")
    above = "trials/" if config.trainer.get("fast_dev_run") else ""
    if config.name is not None:
        return above + inside(str(config.name))
    name = above + ("sweep" if sweep else chosen(config.hydra.runtime.choices))
    settled = config.ckpt in ("last", "auto") or config.overwrite or above
    if settled or any(variable in os.environ for variable in STARTED_BY_OTHERS):
        return name
    return free(name)


def chosen(choices: DictConfig) -> str:
    """Joins the options of the groups, such as ``rgbd-oracle-tiny``; ``quickstart`` for the defaults."""
    names = [choices.get(group) for group in NAMING]
    added = [choices.get(group) for group in ADDED]
    if names == list(NAMING.values()) and not any(added):
        return FIRST
    return "-".join(str(name).replace("/", "_") for name in (*names, *added) if name)


@lru_cache
def free(name: str) -> str:
    """Returns ``name``, or the first ``name-N`` without a run; cached, so it is the same for all jobs of a sweep."""
    number, candidate = 1, name
    while any((Path("outputs", candidate) / part).exists() for part in OF_A_RUN) or _holds_jobs(candidate):
        number += 1
        candidate = f"{name}-{number}"
    return candidate


def _holds_jobs(name: str) -> bool:
    """Whether the folder holds jobs of a sweep, whose folders are numbers."""
    return any(path.name.isdecimal() for path in Path("outputs", name).glob("[0-9]*"))


def inside(name: str) -> str:
    """Returns ``name``; ValueError if it points outside its parent folder."""
    parts = PureWindowsPath(name).parts  # splits at both kinds of slashes
    if not parts or PureWindowsPath(name).drive or name.startswith(("/", "\\")) or ".." in parts:
        raise ValueError(f"name={name} must be a path inside outputs, such as mine or paper/first")
    return name
