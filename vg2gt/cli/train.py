"""``vg2gt train``, or ``python -m vg2gt.cli.train``: ``python train.py`` of a checkout, from any folder."""

from omegaconf import DictConfig

from vg2gt.cli.arguments import hydra_command
from vg2gt.cli.commands import COMMANDS


@hydra_command(COMMANDS["train"], "train")
def main(config: DictConfig) -> None:
    """Runs the training that the configuration describes."""
    # Lightning, which these import, takes seconds.
    from vg2gt.cli.sweeps import needs_own_process, run_in_own_process
    from vg2gt.training.loop import train

    if needs_own_process(config):
        run_in_own_process(config)
    else:
        train(config)


if __name__ == "__main__":
    main()
