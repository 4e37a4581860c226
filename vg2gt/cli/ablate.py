"""``vg2gt ablate``: the paper's ablations on our data."""

from omegaconf import DictConfig

from vg2gt.cli.arguments import hydra_command


@hydra_command("ablate")
def main(config: DictConfig) -> None:
    """Runs the study that the configuration describes."""
    from vg2gt.studies.ablation import run_study

    run_study(config)
