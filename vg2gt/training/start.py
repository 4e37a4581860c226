"""Start of a run: from scratch or from a checkpoint, without silently overwriting another run."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from vg2gt.config import flatten
from vg2gt.io.files import write_text
from vg2gt.runs.checkpoints import (
    by_age,
    checkpoint_path,
    initialize_from,
    model_state,
    newest,
    read_checkpoint,
    refuse_not_finite,
    run_config_path,
)
from vg2gt.runs.load import RESUMED_IN_PLACE, constructor_defaults, earlier_configs, refuse_other_tokens
from vg2gt.runs.untrusted import read_run_config
from vg2gt.training.module import VG2GTModule

_IN_OPTIMIZER = ("training.part", "training.coarse_lr_factor", "training.backend_lr_factor", "backend.freeze")
"""Keys besides ``optimizer.*`` that a checkpoint's optimiser state determines, so that a resumed run ignores them."""
_HARDWARE = "optimizer.fused"  # set by trainer=gpu; does not change what is computed
ORIGIN = ("data", "init_from", "ckpt")  # what a run was trained on, which an evaluation reads
_LOADING = ("data.steps_per_epoch", "data.workers", "data.memory_mb")  # do not change which scenes those are

log = logging.getLogger(__name__)


def checkpoint_to_resume(config: DictConfig) -> Path | None:
    """Returns the checkpoint that ``ckpt`` refers to, or None to start from scratch. Changes no files.

    A run is never restarted silently, and a folder never mixes two runs.

    Raises:
        FileExistsError: if the folder holds another run.
        FileNotFoundError: if ``ckpt`` names no checkpoint.
        ValueError: if the checkpoint's step is beyond ``trainer.max_steps``.
    """
    folder = Path(config.output_dir) / "checkpoints"
    old = by_age(folder)
    if config.ckpt == "last" or (config.ckpt == "auto" and old):
        path = newest(folder)
    elif config.ckpt == "auto":
        log.info("ckpt=auto: no checkpoint in %s yet, the run starts from the beginning", folder)
        return None
    else:
        path = checkpoint_path(config.ckpt)
    if path is None:
        if old and not config.trainer.get("fast_dev_run") and not config.overwrite:
            raise FileExistsError(
                f"{folder} already holds a run ({len(old)} checkpoints): resume with ckpt=last, choose another name=, "
                "or replace it with overwrite=true"
            )
        return None
    step, most = read_checkpoint(path)["global_step"], config.trainer.max_steps
    if old and path.resolve() != old[0].resolve():
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
        FileNotFoundError: if ``init_from`` names no checkpoint or run.
        ValueError: if they are not finite or belong to another model, backbone or optimiser.
    """
    if checkpoint is not None:
        content = read_checkpoint(checkpoint)
        refuse_not_finite(content["state_dict"], checkpoint)
        refuse_other_tokens(config.backend, content, checkpoint)
        module.model.load_trained(model_state(content["state_dict"]), content.get("backend"))
        name_differences(config, checkpoint)
    elif (start := checkpoint_path(config.init_from, "init_from")) is not None:
        initialize_from(module, start)


def prepare_folder(config: DictConfig, checkpoint: Path | None) -> None:
    """Removes half-written files and an overwritten run, and writes ``config.yaml``.

    A resumed run keeps its earlier ``config.yaml`` as ``config-1.yaml`` and so on if its training data or initial
    weights differ, so that an evaluation knows all scenes that it was trained on.
    """
    folder = Path(config.output_dir)
    current = folder / "config.yaml"
    kept, old = earlier_configs(current), by_age(folder / "checkpoints")
    if checkpoint is None or checkpoint.resolve().parent != (folder / "checkpoints").resolve():
        for path in kept:  # of a run that was replaced
            path.unlink()
    elif current.is_file() and _origin(read_run_config(current)) != _origin(config):
        number = 1 + (int(kept[0].stem.removeprefix("config-")) if kept else 0)
        write_text(current.with_name(f"config-{number}.yaml"), current.read_text(encoding="utf-8"))
    for path in [*folder.glob(".*.tmp"), *(folder / "checkpoints").glob("*.tmp")]:
        path.unlink()
    if checkpoint is None and old:
        for path in (folder / "checkpoints").glob("*.ckpt"):
            path.unlink()
        shutil.rmtree(folder / "logs", ignore_errors=True)
        (folder / "metrics.json").unlink(missing_ok=True)
    write_text(current, OmegaConf.to_yaml(config, resolve=True))


def _origin(config: DictConfig) -> dict[str, Any]:
    """What a configuration says about the data that a run's weights come from."""
    plain = flatten(OmegaConf.to_container(config, resolve=True))
    return {
        key: None if key in ("init_from", "ckpt") and value in RESUMED_IN_PLACE else value
        for key, value in plain.items()
        if key.partition(".")[0] in ORIGIN and key not in _LOADING
    }


def name_differences(config: DictConfig, checkpoint: Path) -> None:
    """Logs how a resumed run's configuration differs from that of the checkpoint's run.

    Raises:
        ValueError: if an option that the restored state of the optimiser would override differs.
    """
    path = run_config_path(checkpoint)
    if not path.is_file():
        return
    before, now = (flatten(OmegaConf.to_container(c, resolve=True)) for c in (read_run_config(path), config))
    if (target := now.get("optimizer._target_")) and before.get("optimizer._target_") == target:
        defaults = {f"optimizer.{name}": value for name, value in constructor_defaults(target).items()}
        before, now = defaults | before, defaults | now  # a former version wrote more of them
    different = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    for key in different:
        of_optimizer = "optimizer._target_" in before and key.startswith("optimizer.") and key != _HARDWARE
        if of_optimizer or (key in _IN_OPTIMIZER and key in before and key in now):
            raise ValueError(
                f"{key}={now.get(key, 'not set')} differs from {before.get(key, 'not set')}, with which the run was "
                "trained: a resumed run continues with its optimiser's state, which includes it. Keep the old value, "
                "or start a new run from its weights with name= and init_from="
            )
    different = [key for key in different if key not in ("ckpt", "output_dir", "overwrite")]
    if different:
        log.warning("the resumed run differs from the interrupted one in %s", ", ".join(different))
