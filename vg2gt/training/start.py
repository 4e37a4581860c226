"""Start of a run: from scratch or from a checkpoint, without silently overwriting another run."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from vg2gt.config import flatten
from vg2gt.io.files import write_text
from vg2gt.runs.checkpoints import (
    by_age,
    initialize_from,
    model_state,
    newest_valid,
    read_checkpoint,
    refuse_not_finite,
)
from vg2gt.runs.load import refuse_other_tokens
from vg2gt.runs.trust import read_run_config
from vg2gt.training.checkpointing import BEST
from vg2gt.training.module import VG2GTModule

OPTIMIZER = "optimizer._target_"

log = logging.getLogger(__name__)


def checkpoint_to_resume(config: DictConfig) -> Path | None:
    """Returns the checkpoint that ``ckpt`` refers to, or None to start from scratch. Changes no files.

    A run is never restarted silently, and a folder never mixes two runs.

    Raises:
        FileExistsError: if the folder holds another run.
        FileNotFoundError: if ``ckpt`` names no valid checkpoint.
        ValueError: if the checkpoint's step is beyond ``trainer.max_steps``.
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
            f"{folder} already holds a run ({len(old)} checkpoints): resume with ckpt=last, choose another name=, "
            "or replace it with overwrite=true"
        )
    else:
        return None
    step, most = read_checkpoint(path)["global_step"], config.trainer.max_steps
    if old and not (path.resolve().parent == folder.resolve() and path.name == newest_valid(folder).name):
        raise FileExistsError(
            f"ckpt={path} (step {step}) is not the newest checkpoint of the run in {folder}: resume in a new folder "
            "with name=, or use ckpt=last"
        )
    if 0 <= most < step:
        raise ValueError(
            f"{path} is at step {step}, beyond trainer.max_steps={most}; nothing was changed. Raise "
            "trainer.max_steps to resume, or set another name= for a new run"
        )
    return path


def load_start(module: VG2GTModule, config: DictConfig, checkpoint: Path | None) -> None:
    """Loads the initial weights: those of ``checkpoint``, else of ``init_from``, else none. Writes nothing.

    Raises:
        ValueError: if they are not finite or belong to another model, backbone or optimiser.
    """
    if checkpoint is not None:
        content = read_checkpoint(checkpoint)
        refuse_not_finite(content["state_dict"], checkpoint)
        refuse_other_tokens(config.backend, content, checkpoint)
        module.model.load_trained(model_state(content["state_dict"]), content.get("backend"))
        name_differences(config)
    elif config.init_from:
        initialize_from(module, config.init_from)


def prepare_folder(config: DictConfig, checkpoint: Path | None) -> None:
    """Removes half-written files and an overwritten run, renames damaged checkpoints, writes ``config.yaml``."""
    folder = Path(config.output_dir)
    for path in [*folder.glob(".*.tmp"), *(folder / "checkpoints").glob("*.tmp")]:
        path.unlink()
    old = by_age(folder / "checkpoints")
    if checkpoint is not None:
        for path in old[: next((i for i, path in enumerate(old) if path.name == checkpoint.name), 0)]:
            path.rename(f"{path}.damaged")
            log.warning("%s is damaged and was renamed to *.damaged; continuing from %s", path, checkpoint.name)
    elif old:
        for path in old:
            path.unlink()
        (folder / "checkpoints" / BEST).unlink(missing_ok=True)
        shutil.rmtree(folder / "logs", ignore_errors=True)
        (folder / "metrics.json").unlink(missing_ok=True)
    write_text(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))


def name_differences(config: DictConfig) -> None:
    """Logs how a resumed run's configuration differs from before; raises ValueError if the optimiser does."""
    path = Path(config.output_dir) / "config.yaml"
    if not path.is_file():
        return
    before, now = (flatten(OmegaConf.to_container(c, resolve=True)) for c in (read_run_config(path), config))
    if before.get(OPTIMIZER, now.get(OPTIMIZER)) != now.get(OPTIMIZER):
        raise ValueError(
            f"the run was trained with {before[OPTIMIZER]} and cannot resume with {now[OPTIMIZER]}: start a new run "
            "from its weights with name= and init_from="
        )
    different = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    different = [key for key in different if key not in ("ckpt", "output_dir", "overwrite")]
    if different:
        log.warning("the resumed run differs from the interrupted one in %s", ", ".join(different))
