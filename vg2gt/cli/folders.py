"""Names of runs' folders, as resolvers for the configurations of commands."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from omegaconf import DictConfig, OmegaConf

FIRST = "quickstart"
NAMING = {"data": "synthetic", "backend": "oracle", "model": "tiny"}  # the defaults, whose run is FIRST
ADDED = ("experiment", "ablation")
STARTED_BY_OTHERS = ("LOCAL_RANK", "RANK", "SLURM_PROCID")
OF_A_RUN = ("config.yaml", "checkpoints", ".lock")


def register() -> None:
    """Makes ``${run_folder:}`` and ``${inside:NAME}`` known to OmegaConf."""
    OmegaConf.register_new_resolver("run_folder", run_folder, replace=True)
    OmegaConf.register_new_resolver("inside", inside, replace=True)


def run_folder(_root_: DictConfig) -> str:
    """Folder of a training inside ``outputs``: ``name``, or what was chosen, with a number if that is taken.

    It has no number where a run goes on (``ckpt=last``, ``auto``) or is replaced (``overwrite=true``), and where
    several processes are started at once. Trials (``fast_dev_run``) are kept apart.
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
    """``rgbd-oracle-tiny`` of the groups' options; ``quickstart`` for the defaults."""
    names = [choices.get(group) for group in NAMING]
    added = [choices.get(group) for group in ADDED]
    if names == list(NAMING.values()) and not any(added):
        return FIRST
    return "-".join(str(name).replace("/", "_") for name in (*names, *added) if name)


@lru_cache
def free(name: str) -> str:
    """The name, or the first with a number after it whose folder has no run; the same for all jobs of a sweep."""
    number, candidate = 1, name
    while any((Path("outputs", candidate) / part).exists() for part in OF_A_RUN) or _holds_jobs(candidate):
        number += 1
        candidate = f"{name}-{number}"
    return candidate


def _holds_jobs(name: str) -> bool:
    """Whether a sweep has run there: its jobs' folders are numbers."""
    return any(path.name.isdecimal() for path in Path("outputs", name).glob("[0-9]*"))


def inside(name: str) -> str:
    """The name; ValueError if it leads out of the folder it is a name in."""
    parts = PureWindowsPath(name).parts  # knows both kinds of slashes
    if not parts or PureWindowsPath(name).drive or name.startswith(("/", "\\")) or ".." in parts:
        raise ValueError(f"name={name}: a name inside outputs, such as mine or paper/first; it may not lead out of it")
    return name
