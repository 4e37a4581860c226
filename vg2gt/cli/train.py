"""``vg2gt train``: the same as ``python train.py`` in a checkout, from any folder."""

import hydra
from omegaconf import DictConfig

from vg2gt.paths import config_dir
from vg2gt.training import train


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="train")
def main(config: DictConfig) -> None:
    """Composes the configuration and runs the training."""
    train(config)
