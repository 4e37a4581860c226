"""``vg2gt evaluate``: measures a checkpoint on a data set."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from vg2gt.cli.arguments import hydra_command


def run_name(ckpt: str | None) -> str:
    """Returns the name of a checkpoint's run, for the evaluation's folder; ``untrained`` without a checkpoint."""
    if not ckpt:
        return "untrained"
    parts = [part for part in Path(ckpt).parts if part not in ("outputs", "checkpoints", "/", "..", ".")]
    folders = parts[:-1] if parts[-1:] and parts[-1].endswith(".ckpt") else parts
    return (folders or [Path(ckpt).stem])[-1]


OmegaConf.register_new_resolver("run_name", run_name, replace=True)


@hydra_command("evaluate")
def main(config: DictConfig) -> None:
    """Runs the evaluation that the configuration describes."""
    from vg2gt.evaluation.run import evaluate

    evaluate(config)
