"""``vg2gt calibrate``: calibrates the error bounds of a checkpoint."""

from __future__ import annotations

from omegaconf import DictConfig

from vg2gt.cli.arguments import hydra_command


@hydra_command("calibrate")
def main(config: DictConfig) -> None:
    """Runs the calibration that the configuration describes."""
    from vg2gt.evaluation.calibrate import make_calibration

    make_calibration(config)
