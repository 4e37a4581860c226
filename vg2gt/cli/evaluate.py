"""``vg2gt evaluate``, or ``python -m vg2gt.evaluate``: a checkpoint's figures on a data set."""

import sys

import hydra
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from vg2gt.evaluation.run import evaluate
from vg2gt.evaluation.settings import run_name
from vg2gt.memory import OutOfMemory
from vg2gt.paths import config_dir

OmegaConf.register_new_resolver("run_name", run_name, replace=True)


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="evaluate")
def main(config: DictConfig) -> None:
    """Composes the configuration and runs the evaluation; what the user can mend is said in one line."""
    try:
        evaluate(config)
    except InstantiationException as error:  # what a constructor said
        cause = error.__cause__ or error
        sys.exit(f"{type(cause).__name__}: {cause}")
    except (ValueError, OSError, ImportError, OutOfMemory) as error:
        sys.exit(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
