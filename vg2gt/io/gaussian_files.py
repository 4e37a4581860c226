"""Scenes of Gaussians in any supported format, by file suffix."""

from __future__ import annotations

from pathlib import Path

from vg2gt.io.compressed_ply import write_compressed_ply
from vg2gt.io.gaussian_glb import read_gaussian_glb, write_gaussian_glb
from vg2gt.io.ply import read_gaussian_ply, write_gaussian_ply
from vg2gt.io.splat import read_splat, write_splat
from vg2gt.io.spz import read_spz, write_spz
from vg2gt.types import Gaussians

READERS = {".ply": read_gaussian_ply, ".splat": read_splat, ".spz": read_spz, ".glb": read_gaussian_glb}
WRITERS = {
    ".compressed.ply": write_compressed_ply,
    ".ply": write_gaussian_ply,
    ".splat": write_splat,
    ".spz": write_spz,
    ".glb": write_gaussian_glb,
}


def read_gaussians(path: str | Path) -> Gaussians:
    """Reads a scene; the suffix selects one of :data:`READERS`.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it cannot be read or the suffix is unknown.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: expected a scene of Gaussians, {', '.join(READERS)}")
    if not path.is_file():
        raise FileNotFoundError(f"no scene at {path}")
    return reader(path)


def write_gaussians(path: str | Path, gaussians: Gaussians) -> Path:
    """Writes one scene's Gaussians atomically; the suffix selects one of :data:`WRITERS`.

    Raises:
        ValueError: if the suffix is unknown, or a value cannot be written.
    """
    for suffix, write in WRITERS.items():
        if str(path).lower().endswith(suffix):
            return write(path, gaussians)
    raise ValueError(f"{path}: a scene of Gaussians ends in {', '.join(WRITERS)}")
