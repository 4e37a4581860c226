"""VG²GT: feed-forward Gaussian reconstruction on frozen visual foundation models."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vg2gt.api import Pipeline, load
    from vg2gt.model import VG2GT
    from vg2gt.reconstruction.scene import Scene
    from vg2gt.runs.pretrained import list_models, push_to_hub, save_pretrained

__all__ = ["VG2GT", "Pipeline", "Scene", "list_models", "load", "push_to_hub", "save_pretrained"]
__version__ = "0.1.0"

_HOMES = {
    "VG2GT": "vg2gt.model",
    **dict.fromkeys(("Pipeline", "load"), "vg2gt.api"),
    **dict.fromkeys(("list_models", "push_to_hub", "save_pretrained"), "vg2gt.runs.pretrained"),
    "Scene": "vg2gt.reconstruction.scene",
}


def source() -> str:
    """Returns ``git describe`` of this checkout or of the one the wheel was built from; ``unknown`` without either."""
    stored = Path(__file__).with_name("SOURCE")
    if stored.is_file():
        return stored.read_text().strip()
    command = ["git", "-C", str(Path(__file__).parents[1]), "describe", "--always", "--dirty", "--tags"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def __getattr__(name: str) -> Any:
    """Imports public names on first use: torch and Hydra take seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
