"""How a run begins: anew or from a checkpoint of its folder, never silently over another run."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import lightning
from omegaconf import DictConfig, OmegaConf

from vg2gt.config import flatten
from vg2gt.io.files import write_text
from vg2gt.runs.checkpoints import newest_valid, read_checkpoint
from vg2gt.runs.trust import read_run_config

OPTIMIZER = "optimizer._target_"

log = logging.getLogger(__name__)


def checkpoint_to_resume(config: DictConfig) -> Path | None:
    """Resolves ``ckpt``; never restarts a run silently and never mixes two runs in one folder. Changes nothing.

    Raises:
        FileExistsError: if the folder holds another run.
        FileNotFoundError: if ``ckpt`` names no valid checkpoint.
        ValueError: if the checkpoint is further than the run is asked to go.
    """
    folder = Path(config.output_dir) / "checkpoints"
    old = sorted(folder.glob("*.ckpt"))
    if config.ckpt == "last" or (config.ckpt == "auto" and old):
        path = newest_valid(folder)
    elif config.ckpt == "auto":
        log.info("ckpt=auto: no checkpoint in %s yet, the run starts from the beginning", folder)
        return None
    elif config.ckpt:
        path = Path(config.ckpt)
    elif old and not config.trainer.get("fast_dev_run") and not config.overwrite:
        raise FileExistsError(
            f"{folder} already holds a run ({len(old)} checkpoints): go on with ckpt=last, choose another name=, "
            "or replace it with overwrite=true"
        )
    else:
        return None
    step, most = read_checkpoint(path)["global_step"], config.trainer.max_steps
    if old and not (path.resolve().parent == folder.resolve() and path.name == newest_valid(folder).name):
        raise FileExistsError(
            f"ckpt={path} (step {step}) is not the newest checkpoint of the run in {folder}: go on in a new folder "
            "with name=, or with ckpt=last"
        )
    if 0 <= most < step:
        raise ValueError(
            f"{path} is at step {step}, further than trainer.max_steps={most} asks: nothing was changed. Raise "
            "trainer.max_steps to go on, or take another name= to train anew"
        )
    return path


def clear(folder: Path) -> None:
    """Removes the run that ``overwrite=true`` replaces: neither its curve nor its result are the new run's."""
    old = sorted((folder / "checkpoints").glob("*.ckpt"))
    for path in old:
        path.unlink(missing_ok=True)
    if old:
        shutil.rmtree(folder / "logs", ignore_errors=True)
        (folder / "metrics.json").unlink(missing_ok=True)


def name_differences(config: DictConfig) -> None:
    """Says in the log what a resumed run does otherwise than the interrupted one.

    Raises:
        ValueError: if it has another optimiser, to which the moments of the checkpoint mean nothing.
    """
    path = Path(config.output_dir) / "config.yaml"
    if not path.is_file():
        return
    before, now = (flatten(OmegaConf.to_container(c, resolve=True)) for c in (read_run_config(path), config))
    if before.get(OPTIMIZER, now.get(OPTIMIZER)) != now.get(OPTIMIZER):
        raise ValueError(
            f"the run was trained with {before[OPTIMIZER]} and cannot go on with {now[OPTIMIZER]}: start a new one "
            "from its weights, with another name= and init_from="
        )
    different = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    different = [key for key in different if key not in ("ckpt", "output_dir", "overwrite")]
    if different:
        log.warning("the resumed run differs from the interrupted one in %s", ", ".join(different))


class WriteConfig(lightning.Callback):
    """Writes a run's configuration, of one that goes on once its first step is sure to be taken.

    Args:
        path: the file.
        text: the resolved configuration.
    """

    def __init__(self, path: Path, text: str) -> None:
        self.path, self.text = path, text

    def write(self) -> None:
        """Writes the file."""
        write_text(self.path, self.text)

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Writes it when everything of the checkpoint was restored."""
        self.write()
