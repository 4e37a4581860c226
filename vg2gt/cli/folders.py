"""Names of run folders, as OmegaConf resolvers for the configurations of commands."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

FIRST = "quickstart"
_NAMING = {"data": "synthetic", "backend": "oracle", "model": "tiny"}  # a run with these defaults is named FIRST
_ADDED = ("experiment", "ablation")
STARTED_BY_OTHERS = ("LOCAL_RANK", "RANK", "SLURM_PROCID")
_OF_A_RUN = ("config.yaml", "checkpoints", ".lock", "[0-9]*")  # the last: jobs of a sweep


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
    names = [choices.get(group) for group in _NAMING]
    added = [choices.get(group) for group in _ADDED]
    if names == list(_NAMING.values()) and not any(added):
        return FIRST
    return "-".join(str(name).replace("/", "_") for name in (*names, *added) if name)


@lru_cache
def free(name: str) -> str:
    """Returns ``name``, or the first ``name-N`` without a run; cached, so it is the same for all jobs of a sweep."""
    number, candidate = 1, name
    while any(path for part in _OF_A_RUN for path in Path("outputs", candidate).glob(part)):
        number += 1
        candidate = f"{name}-{number}"
    return candidate


def inside(name: str) -> str:
    """Returns ``name``; ValueError if it points outside its parent folder."""
    path = Path(name)
    if not path.parts or path.is_absolute() or ".." in path.parts:
        raise ValueError(f"name={name} must be a path inside outputs, such as mine or paper/first")
    return name
