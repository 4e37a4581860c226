"""Models by name: shipped with the package, in a folder, or on the Hugging Face Hub; safetensors only, no pickles."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from vg2gt.io.files import write_bytes, write_text
from vg2gt.runs.checkpoints import MADE_OF, checkpoint_path, read_checkpoint, write_slim
from vg2gt.runs.load import SHIPPED, calibration_path

WEIGHTS, _CONFIG = "model.safetensors", "model.yaml"
_CALIBRATION = calibration_path(Path(WEIGHTS)).name
MODELS = {"sweep-tiny": SHIPPED}
"""Checkpoints of the models that ship with the package, by name; it also contains their backbone's weights."""


def list_models() -> tuple[str, ...]:
    """Returns the names of the models that ship with the package, for :func:`vg2gt.load`."""
    return tuple(MODELS)


def save_pretrained(ckpt: str | Path, folder: str | Path) -> Path:
    """Writes a trained model for sharing: weights, configuration as YAML, and calibration if there is one.

    Args:
        ckpt: a run's folder or checkpoint.
        folder: output folder, created if needed.

    Returns:
        The output folder.

    Raises:
        FileNotFoundError: if there is no such run or checkpoint.
        ValueError: if the checkpoint holds no configuration.
    """
    folder = Path(folder).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = checkpoint_path(ckpt)
    assert checkpoint is not None
    write_slim(checkpoint, folder / WEIGHTS)
    if (known := calibration_path(checkpoint)).is_file():
        write_bytes(folder / _CALIBRATION, known.read_bytes())
    write_text(folder / _CONFIG, str(read_checkpoint(checkpoint)[MADE_OF]))
    return folder


def push_to_hub(ckpt: str | Path, repo: str, folder: str | Path, private: bool = False) -> str:
    """Saves a model into a folder and uploads it.

    Args:
        ckpt: a run's folder or checkpoint.
        repo: ``OWNER/NAME``; created if needed, with the account of ``hf auth login``.
        folder: local folder for :func:`save_pretrained`.
        private: whether to make a new repository private.

    Returns:
        The URL of the commit.

    Raises:
        ImportError: if huggingface_hub is not installed.
        FileNotFoundError, ValueError: as in :func:`save_pretrained`.
    """
    try:
        from huggingface_hub import HfApi  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("push_to_hub needs huggingface_hub: pip install 'vg2gt[hub]'") from error
    saved = save_pretrained(ckpt, folder)
    api = HfApi()
    api.create_repo(repo, private=private, exist_ok=True)
    return str(api.upload_folder(repo_id=repo, folder_path=str(saved), allow_patterns=[WEIGHTS, _CONFIG, _CALIBRATION]))


def weights_file(name: str | Path, revision: str | None = None) -> Path:
    """Returns the weights of a model by name, downloaded if it is on the Hub; arguments as for :func:`vg2gt.load`."""
    if str(name) in MODELS:
        return MODELS[str(name)]
    path = Path(name).expanduser()
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    if path.exists() or not re.fullmatch(r"[\w.-]+/[\w.-]+", str(name)):
        found = checkpoint_path(path)
        assert found is not None
        return found
    try:
        from huggingface_hub import hf_hub_download  # pyright: ignore[reportMissingImports]
        from huggingface_hub.errors import EntryNotFoundError  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            f"folder {name} does not exist; loading it from the hub needs huggingface_hub: pip install 'vg2gt[hub]'"
        ) from error
    with suppress(EntryNotFoundError):  # the model is not calibrated
        hf_hub_download(str(name), _CALIBRATION, revision=revision)
    return Path(hf_hub_download(str(name), WEIGHTS, revision=revision))
