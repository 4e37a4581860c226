"""``vg2gt data synthetic | splits | views``: what is made of data before training or evaluating."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING

from vg2gt.cli.arguments import key_value_command, read_options
from vg2gt.cli.commands import DATA_COMMANDS, dispatch
from vg2gt.config import compose

if TYPE_CHECKING:
    from vg2gt.data.datamodule import SceneDataModule
    from vg2gt.data.synthetic.export import SceneSettings


def main() -> None:
    """Runs ``vg2gt data COMMAND [arguments]``."""
    dispatch("vg2gt data", DATA_COMMANDS)


def data_module(overrides: Sequence[str]) -> SceneDataModule:
    """The data that the arguments of ``vg2gt train`` choose."""
    from hydra.utils import instantiate

    return instantiate(compose("train", *overrides).data)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class SyntheticOptions:
    """Options of ``vg2gt data synthetic``; most are those of :class:`SceneSettings`."""

    out: str = MISSING
    scenes: int = 100
    first_seed: int = 0
    frames: int = 16
    size: tuple[int, int] = (224, 448)
    variant: Any = "room"
    highlights: Any = False
    normals: bool = False
    depth_scale: float = 1000.0
    exposure: float = 0.0
    jpeg: Any = None
    workers: int = field(default_factory=_cores)

    @property
    def settings(self) -> SceneSettings:
        """The options that decide what a scene holds."""
        from vg2gt.data.synthetic.export import SceneSettings

        chosen: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(SceneSettings)}
        return SceneSettings(**{**chosen, "size": tuple(self.size)})


@key_value_command(DATA_COMMANDS["synthetic"])
def synthetic(arguments: list[str]) -> None:
    """Writes synthetic scenes as RGB-D recordings for data=rgbd; run it again to continue or to add scenes.

    vg2gt data synthetic out=FOLDER [key=value ...]

      scenes=100        how many
      first_seed=0      seed of the first one
      frames=16         frames per scene
      size=[224,448]    image height and width
      variant=room      room, outdoor, wide, object, landmark, or a list that takes turns: [room,room,outdoor]
      highlights=false  surfaces shine: colours depend on the view; lobes: strongly
      normals=false     write normals/NNNNN.npz too
      depth_scale=1000  stored depth units per metre; deeper than 65534 units is written as no depth
      exposure=0        scenes too dark or too bright, standard deviation in stops
      jpeg=null         [30,95]: images are compressed at qualities of this range
      workers=N         processes; as many as there are cores
    """
    from rich.progress import track

    from vg2gt.data.synthetic.export import missing_scenes, write_scenes

    options, unknown = read_options(SyntheticOptions, arguments)
    if unknown:
        known = ", ".join(f"{field.name}=" for field in fields(SyntheticOptions))
        raise ValueError(f"unknown option {unknown[0]!r}; options are {known}")
    if options.workers < 1:
        raise ValueError(f"option workers: must be at least 1, got {options.workers}")
    started = time.perf_counter()
    out = Path(options.out).expanduser()
    names = missing_scenes(out, options.scenes, options.first_seed, options.settings)
    try:
        for _ in track(write_scenes(out, names, options.settings, options.workers), "scenes", total=len(names)):
            pass
    except BrokenProcessPool as error:
        raise OSError(
            "a process was killed (too little memory?); finished scenes are kept, run the command again"
        ) from error
    except KeyboardInterrupt:
        raise SystemExit("interrupted; finished scenes are kept, run the command again to continue") from None
    seconds = time.perf_counter() - started
    print(
        f"{out}: wrote {len(names)} scenes of {options.frames} frames in {seconds:.0f} s, "
        f"{options.scenes - len(names)} were there; use them: vg2gt train data=rgbd data.root={out}"
    )


@dataclass
class SplitOptions:
    """Options of ``vg2gt data splits``."""

    out: str = MISSING
    fraction: float = 0.1
    split_seed: int = 0


@key_value_command(DATA_COMMANDS["splits"])
def splits(arguments: list[str]) -> None:
    """Divides the scenes of a dataset into training and evaluation lists; recordings of one place stay together.

    vg2gt data splits out=FOLDER data=rgbd data.root=RECORDINGS [key=value ...]

      out=FOLDER        where train.txt and val.txt are written
      fraction=0.1      share of the places that goes to val.txt, of every part of a mixture
      split_seed=0      another seed, another division

    All other arguments choose the dataset as in `vg2gt train`; the scenes of data.train are divided. Use the lists with
    data.train.scenes=FOLDER/train.txt data.val.scenes=FOLDER/val.txt
    """
    from vg2gt.data.splits import write_splits

    options, overrides = read_options(SplitOptions, arguments)
    source = data_module(overrides).train_source()
    for path in write_splits(Path(options.out).expanduser(), source, options.fraction, options.split_seed):
        print(f"{path}: {len(path.read_text().splitlines()) - 1} scenes")


@dataclass
class ViewOptions:
    """Options of ``vg2gt data views``."""

    out: str = MISSING


@key_value_command(DATA_COMMANDS["views"])
def views(arguments: list[str]) -> None:
    """Makes an index of views: which views of which scenes an evaluation takes.

    vg2gt data views evaluation=rgbd data.root=FOLDER out=FILE.json [key=value ...]

    All arguments but out are those of `vg2gt evaluate`; they say which data, which scenes (data.eval_scenes), which
    numbers of views and how they are drawn (evaluation.selection). The file is then read with
    evaluation.selection.index=FILE.json. Equal arguments and data give equal files.
    """
    print(write_views(arguments))


def write_views(arguments: Sequence[str]) -> Path:
    """Writes the index that the arguments ask for; returns its path.

    Raises:
        ValueError: if ``out`` is missing or an argument is wrong.
        DataError: if a scene has too few frames.
    """
    from hydra.utils import instantiate

    from vg2gt.data.views.drawn import make_index
    from vg2gt.evaluation.run import view_counts
    from vg2gt.io.files import write_text

    options, overrides = read_options(ViewOptions, arguments)
    if not options.out.endswith(".json"):
        raise ValueError(f"give the index file to write, out=FILE.json, got out={options.out}")
    config = compose("evaluate", "output_dir=.", "name=index", *overrides)
    evaluation = instantiate(config.evaluation, _convert_="all")
    datamodule: SceneDataModule = instantiate(config.data)
    source = datamodule.evaluation_data().source
    scenes = list(source.scenes)[: datamodule.eval_scenes]
    index = make_index(evaluation.selection, source, scenes, view_counts(config.views))
    # One line per list of frames: readable, and a change of one draw is a change of one line.
    text = re.sub(r"\[[^\[\]{}]*\]", lambda found: re.sub(r"\s+", " ", found[0]), json.dumps(index, indent=1))
    return write_text(options.out, text.replace("[ ", "[").replace(" ]", "]") + "\n")


if __name__ == "__main__":
    main()
