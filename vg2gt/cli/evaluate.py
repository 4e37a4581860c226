"""``vg2gt evaluate``, or ``python -m vg2gt.evaluate``: a checkpoint's figures on a data set."""

import hydra
from omegaconf import DictConfig, OmegaConf

from vg2gt.cli.errors import said_in_one_line
from vg2gt.config import config_dir
from vg2gt.evaluation.run import evaluate
from vg2gt.runs.load import run_name

OmegaConf.register_new_resolver("run_name", run_name, replace=True)


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="evaluate")
def main(config: DictConfig) -> None:
    """Composes the configuration and runs the evaluation; what the user can mend is said in one line."""
    with said_in_one_line():
        evaluate(config)


if __name__ == "__main__":
    main()
