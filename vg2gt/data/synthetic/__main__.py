"""Writes synthetic scenes as RGB-D recordings for data=rgbd; run it again to continue or to add scenes.

python -m vg2gt.data.synthetic out=FOLDER [key=value ...]

  scenes=100        how many
  first_seed=0      seed of the first one
  frames=16         frames a scene
  size=[224,448]    image height and width
  variant=room      room, outdoor, or a list that takes turns: [room,room,outdoor]
  highlights=false  surfaces shine: colours depend on the view
  normals=false     write normals/NNNNN.npz too
  depth_scale=1000  stored depth units a metre; deeper than 65534 units is written as no depth
  workers=N         processes; as many as there are cores
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class Options:
    """The command's options; most are those of :class:`SceneSettings`."""

    out: str = MISSING
    scenes: int = 100
    first_seed: int = 0
    frames: int = 16
    size: tuple[int, int] = (224, 448)
    variant: Any = "room"
    highlights: bool = False
    normals: bool = False
    depth_scale: float = 1000.0
    workers: int = _cores()

    @property
    def settings(self) -> SceneSettings:
        """The options that decide what a scene holds."""
        chosen: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(SceneSettings)}
        chosen["size"] = tuple(self.size)
        return SceneSettings(**chosen)


def parse(arguments: Sequence[str]) -> Options:
    """Reads ``key=value`` arguments.

    Raises:
        ValueError: naming the argument that is unknown, has no value or one of the wrong type.
    """
    known = [field.name for field in fields(Options)]
    for argument in arguments:
        key, equals, _ = argument.partition("=")
        if key not in known or not equals:
            raise ValueError(f"unknown option {argument!r}; options are {', '.join(f'{name}=' for name in known)}")
    try:
        config = OmegaConf.merge(OmegaConf.structured(Options), OmegaConf.from_dotlist(list(arguments)))
        options = OmegaConf.to_object(config)
    except OmegaConfBaseException as error:
        if error.full_key == "out":
            raise ValueError("name the folder to write: out=FOLDER") from error
        raise ValueError(f"option {error.full_key}: {str(error).splitlines()[0]}") from error
    assert isinstance(options, Options)
    if options.workers < 1:
        raise ValueError(f"option workers: must be at least 1, got {options.workers}")
    return options


def main(arguments: Sequence[str]) -> None:
    """The command line.

    Raises:
        SystemExit: with the message, if the arguments are wrong or the scenes cannot be written.
    """
    if not arguments or {"-h", "--help"} & set(arguments):
        print(__doc__)
        sys.exit(0 if arguments else 2)
    columns = (TextColumn("scenes"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    started = time.perf_counter()
    try:
        options = parse(arguments)
        out = Path(options.out).expanduser()
        names = missing_scenes(out, options.scenes, options.first_seed, options.settings)
        with Progress(*columns) as progress:
            finished = write_scenes(out, names, options.settings, options.workers)
            for _ in progress.track(finished, total=len(names)):
                pass
    except (OSError, ValueError) as error:
        sys.exit(f"synthetic: {error}")
    except BrokenProcessPool:
        sys.exit(
            "synthetic: a process was killed (too little memory?); finished scenes are kept, run the command again"
        )
    except KeyboardInterrupt:
        sys.exit("synthetic: interrupted; finished scenes are kept, run it again to continue")
    seconds = time.perf_counter() - started
    print(
        f"{out}: wrote {len(names)} scenes of {options.frames} frames in {seconds:.0f} s, "
        f"{options.scenes - len(names)} were there; use them: python train.py data=rgbd data.root={out}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
