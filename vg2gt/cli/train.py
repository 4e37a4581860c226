"""``vg2gt train``, or ``python -m vg2gt.cli.train``: ``python train.py`` of a checkout, from any folder."""

import hydra
from omegaconf import DictConfig

from vg2gt.cli.errors import said_in_one_line
from vg2gt.cli.sweeps import needs_own_process, run_in_own_process
from vg2gt.config import config_dir
from vg2gt.training.loop import train


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="train")
def main(config: DictConfig) -> None:
    """Composes the configuration and runs the training; what the user can mend is said in one line."""
    with said_in_one_line():
        if needs_own_process(config):
            run_in_own_process(config)
        else:
            train(config)


if __name__ == "__main__":
    main()
