"""Finding the scenes of a dataset below its folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vg2gt.data.base import DataError


def scene_folders(
    root: Path, is_scene: Callable[[Path], bool], levels: int = 2, by_path: bool = False
) -> dict[str, Path]:
    """The folder itself if it is a scene, else the scenes up to ``levels`` folders below it.

    Args:
        root: where to look.
        is_scene: whether a folder is a scene.
        levels: how deep to look.
        by_path: name scenes by their path below ``root``, not by their folder's name.

    Raises:
        DataError: if two scenes get one name.
    """
    if is_scene(root):
        return {root.resolve().name: root}
    found: dict[str, Path] = {}
    for depth in range(1, levels + 1):
        for folder in sorted(root.glob("/".join("*" * depth))):
            if not folder.is_dir() or not is_scene(folder):
                continue
            name = folder.relative_to(root).as_posix() if by_path else folder.name
            if name in found:
                raise DataError(f"two scenes are called {name}: {found[name]} and {folder}; give data.root one of them")
            found[name] = folder
    return found
