"""``vg2gt train``, or ``python -m vg2gt.cli.train``: ``python train.py`` of a checkout, from any folder."""

from omegaconf import DictConfig

from vg2gt.cli.allocator import start_with_mimalloc
from vg2gt.cli.arguments import hydra_command
from vg2gt.cli.commands import COMMANDS


@hydra_command(COMMANDS["train"], "train")
def main(config: DictConfig) -> None:
    """Runs the training that the configuration describes."""
    from vg2gt.training.compilation import begin_compiling

    compiling = begin_compiling(config)
    # Lightning, which these import, takes seconds.
    from vg2gt.cli.sweeps import needs_own_process, run_in_own_process
    from vg2gt.training.loop import train

    if needs_own_process(config):
        run_in_own_process(config)
    else:
        train(config, compiling)


if __name__ == "__main__":
    start_with_mimalloc()
    main()
