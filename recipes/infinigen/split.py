"""Splits rooms into one scene per kind of camera path: ``python split.py FOLDER``, the output folder of ``make.py``.

Loaders draw neighbouring frames, but views of different paths of a room hardly overlap. The new scenes are folders of
links, ``FOLDER/paths/PART/ROOM/KIND``. Turns on the spot are left out, as they have no parallax. Existing scenes are
kept. Needs only the standard library.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

_FRAME = 3  # position of the frame number in names such as Image_0_0_0007_0


def split(out: Path) -> Iterator[Path]:
    """Links the frames of every room in ``out``; yields the new scenes.

    Raises:
        FileNotFoundError: if there are no rooms.
    """
    rooms = sorted(room for part in ("train", "held_out") for room in (out / part).glob("room_*"))
    if not rooms:
        raise FileNotFoundError(f"no rooms in {out}/train or {out}/held_out: make them with make.py --out {out}")
    for room in rooms:
        kinds: dict[str, set[int]] = {}
        for number, view in enumerate(json.loads((room / "views.json").read_text())):
            kinds.setdefault(view["path"].rsplit("_", 1)[0], set()).add(number)
        kinds.pop("turn", None)
        for kind, numbers in kinds.items():
            scene = out / "paths" / room.parent.name / room.name / kind
            if not scene.exists():
                _link(room, scene, numbers)
                yield scene


def _link(room: Path, scene: Path, numbers: set[int]) -> None:
    new = scene.with_name(f"{scene.name}.new")  # renamed when complete
    shutil.rmtree(new, ignore_errors=True)
    for path in sorted(room.glob("frames/*/camera_*/*")):
        if int(path.stem.split("_")[_FRAME]) in numbers:
            link = new / path.relative_to(room)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(os.path.relpath(path, link.parent))
    new.rename(scene)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="output folder of make.py")
    try:
        for made in split(parser.parse_args().folder.resolve()):
            print(made)
    except FileNotFoundError as error:
        parser.error(str(error))
