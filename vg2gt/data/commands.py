"""What the commands on datasets share: ``key=value`` arguments, of which most choose the dataset as in training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vg2gt.config import config_dir
from vg2gt.data.datamodule import SceneDataModule


def parse(arguments: Sequence[str], options: dict[str, Any]) -> tuple[dict[str, Any], SceneDataModule]:
    """Divides arguments into a command's own and those of ``python train.py``, and makes the data module.

    Args:
        arguments: ``key=value`` each; unknown keys go to the training configuration (``data=rgbd data.root=...``).
        options: the command's own keys with their defaults; a default of None must be given.

    Raises:
        ValueError: naming an argument that is missing, unknown or of the wrong type.
    """
    own = [argument for argument in arguments if argument.partition("=")[0] in options]
    others = [argument for argument in arguments if argument not in own]
    chosen = dict(options)
    for argument in own:
        key, _, text = argument.partition("=")
        wanted = type(options[key]) if options[key] is not None else str
        value = text if wanted is str else _read(text)
        if not isinstance(value, wanted) and not (wanted is float and isinstance(value, int)):
            raise ValueError(f"option {key} takes a value of type {wanted.__name__}, got {text!r}")
        chosen[key] = value
    missing = [key for key, value in chosen.items() if value in (None, "")]
    if missing:
        raise ValueError(f"give {missing[0]}=")
    try:
        with initialize_config_dir(config_dir(), version_base="1.3"):
            config = compose("train", ["hydra/job_logging=default", *others])
        module = instantiate(config.data)
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(str(error)) from error
    return chosen, module


def _read(text: str) -> Any:
    """A value as YAML has it."""
    value = OmegaConf.from_dotlist([f"value={text}"]).value
    return OmegaConf.to_object(value) if OmegaConf.is_config(value) else value
