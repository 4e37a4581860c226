"""What the command and Python share: a loaded model that turns images into a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vg2gt.reconstruction.pipeline import Pipeline
from vg2gt.runs.load import load_model
from vg2gt.runs.pretrained import weights_file


def load(
    name: str | Path | None = None,
    backend: str | None = None,
    *,
    overrides: Sequence[str] = (),
    revision: str | None = None,
    device: str = "auto",
) -> Pipeline:
    """Loads a model that turns images into scenes.

    Args:
        name: a run's folder or checkpoint, one of :func:`vg2gt.list_models`, a folder written by
            :func:`vg2gt.save_pretrained`, or ``OWNER/NAME`` on the Hugging Face Hub. None: the weights that ship with
            the package; with another backend than ``sweep``, an untrained head, which predicts coloured voxels.
        backend: an option of ``backend=``; None: the backend that the model was trained with.
        overrides: changes of the model's configuration as on the command line, such as
            ``["model.fine.max_voxels=500000"]``.
        revision: revision of a model on the Hub.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        The model in eval mode with its renderer, its calibration and the origin of its weights.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        OSError: if there is no such repository on the Hub.
        ImportError: if a package is missing that the backend or the Hub needs.
        ValueError: if a name or an option is unknown, or the model was trained on another backbone.
    """
    weights = None if name is None else weights_file(name, revision)
    return Pipeline(**vars(load_model(weights, backend, overrides, device)))
