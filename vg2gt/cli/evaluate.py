"""``vg2gt evaluate``: a checkpoint's figures on a data set."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from vg2gt.cli.arguments import hydra_command
from vg2gt.cli.commands import COMMANDS


def run_name(ckpt: str | None) -> str:
    """Name of the run to which a checkpoint belongs, for the evaluation's folder; ``untrained`` without one."""
    if not ckpt:
        return "untrained"
    parts = [part for part in Path(ckpt).parts if part not in ("outputs", "checkpoints", "/", "..", ".")]
    folders = parts[:-1] if parts[-1:] and parts[-1].endswith(".ckpt") else parts
    return (folders or [Path(ckpt).stem])[-1]


OmegaConf.register_new_resolver("run_name", run_name, replace=True)


@hydra_command(COMMANDS["evaluate"], "evaluate")
def main(config: DictConfig) -> None:
    """Runs the evaluation that the configuration describes."""
    from vg2gt.evaluation.run import evaluate

    evaluate(config)
