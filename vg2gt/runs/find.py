"""Where a run's files are."""

from __future__ import annotations

from pathlib import Path

from vg2gt.runs.checkpoints import newest_valid

_EXAMPLES = "a run's folder such as outputs/quickstart"


def checkpoint_path(ckpt: str | Path | None) -> Path | None:
    """The checkpoint file that ``ckpt`` means: itself, or the newest valid one of a run's folder.

    Raises:
        FileNotFoundError: if there is none.
    """
    if ckpt is None:
        return None
    path = Path(ckpt)
    if path.is_dir():
        folder = path / "checkpoints" if (path / "checkpoints").is_dir() else path
        try:
            return newest_valid(folder)
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"ckpt={ckpt}: no valid checkpoint in {folder}; give {_EXAMPLES}, a checkpoint's file, or ckpt=null "
                "for the untrained head"
            ) from error
    if not path.is_file():
        raise FileNotFoundError(
            f"ckpt={ckpt}: no such checkpoint or run; give a file, {_EXAMPLES}, or ckpt=null for the untrained head"
        )
    return path


def run_config_path(checkpoint: Path) -> Path:
    """Where the configuration of a checkpoint's run is."""
    return checkpoint.resolve().parent.parent / "config.yaml"
