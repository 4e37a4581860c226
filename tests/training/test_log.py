"""What a run's terminal and log file show."""

from pathlib import Path

from tests.commands import run_python

# Imports, configures and logs in the order of a run; loggers are global, hence in a process of its own.
RUN = """
import logging, sys
import hydra
import vg2gt.training.loop
from vg2gt.cli.folders import register
from vg2gt.config import config_dir

register()

@hydra.main(version_base="1.3", config_path=config_dir(), config_name="train")
def main(config):
    lightning = ("lightning", "lightning.pytorch.utilities.rank_zero", "lightning.fabric.strategies")
    for name in ("vg2gt.training.loop", *lightning):
        logging.getLogger(name).warning("heard of %s", name)
    logging.getLogger("lightning.pytorch.profilers.profiler").info("heard of profiler")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").info("not heard of")

main()
"""


def test_every_message_comes_once_to_the_terminal_and_to_the_file(tmp_path: Path) -> None:
    result = run_python(RUN, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    (file,) = tmp_path.glob("outputs/**/run.log")
    for text in (result.stdout + result.stderr, file.read_text()):
        heard = [line for line in text.splitlines() if "heard of" in line]
        assert [line.rsplit(" ", 1)[1].split(".")[0] for line in heard] == ["vg2gt", *["lightning"] * 3, "profiler"], (
            text
        )
