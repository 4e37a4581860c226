"""``vg2gt data synthetic | splits | views``: what is made of data before training or evaluating."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.cli.arguments import flag_parser, list_of_names, separate
from vg2gt.cli.commands import DATA_COMMANDS, dispatch
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.config import compose

if TYPE_CHECKING:
    from vg2gt.data.datamodule import SceneDataModule
    from vg2gt.data.synthetic.export import SceneSettings

SYNTHETIC = "\nRun it again to continue or to add scenes; data=rgbd reads them."
SPLITS = """
key=value arguments choose the dataset as in vg2gt train; the scenes of data.train are divided, recordings of one place
stay together. Use the lists with data.train.scenes=DIR/train.txt data.val.scenes=DIR/val.txt"""
VIEWS = """
key=value arguments are those of vg2gt evaluate: which data, which scenes (data.eval_scenes), which numbers of views and
how they are drawn (evaluation.selection). Read the file with evaluation.selection.index=FILE.json. Equal arguments and
data give equal files."""


def main() -> None:
    """Runs ``vg2gt data COMMAND [arguments]``."""
    dispatch("vg2gt data", DATA_COMMANDS)


def synthetic(argv: Sequence[str] | None = None) -> None:
    """Writes synthetic scenes as RGB-D recordings."""
    parser = flag_parser("data synthetic", DATA_COMMANDS["synthetic"], SYNTHETIC)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="where to write")
    add("--scenes", type=int, default=100, metavar="N", help="how many, default 100")
    add("--first-seed", type=int, default=0, metavar="N", help="seed of the first one, default 0")
    add("--frames", type=int, default=16, metavar="N", help="frames per scene, default 16")
    add("--size", type=int, nargs=2, default=(224, 448), metavar=("H", "W"), help="of the images, default 224 448")
    add("--variant", type=list_of_names, default=["room"], metavar="LIST", help="room, outdoor, wide, object, landmark "
        "or several that take turns: room,room,outdoor")  # fmt: skip
    add("--highlights", choices=("none", "soft", "lobes"), default="none", help="surfaces shine; lobes: strongly")
    add("--normals", action="store_true", help="write normals/NNNNN.npz too")
    add("--depth-scale", type=float, default=1000.0, metavar="X", help="stored depth units per metre, default 1000; "
        "deeper than 65534 units is written as no depth")  # fmt: skip
    add("--exposure", type=float, default=0.0, metavar="X", help="scenes too dark or bright, deviation in stops")
    add("--jpeg", type=int, nargs=2, metavar="Q", help="compress images at qualities of this range, such as 30 95")
    add("--workers", type=int, default=cores, metavar="N", help="processes; default: as many as there are cores")
    options = parser.parse_args(argv)
    with errors_in_one_line():
        from vg2gt.data.synthetic.export import SceneSettings

        variant = options.variant[0] if len(options.variant) == 1 else options.variant
        highlights = {"none": False, "soft": True}.get(options.highlights, options.highlights)
        settings = SceneSettings(
            options.frames, tuple(options.size), variant, highlights, options.normals, options.depth_scale,
            options.exposure, options.jpeg,
        )  # fmt: skip
        write_synthetic(options.out.expanduser(), options.scenes, options.first_seed, settings, options.workers)


def write_synthetic(out: Path, scenes: int, first_seed: int, settings: SceneSettings, workers: int) -> None:
    """Writes those of the scenes that are missing in ``out``; OSError if a process was killed."""
    from rich.progress import track

    from vg2gt.data.synthetic.export import missing_scenes, write_scenes

    if workers < 1:
        raise ValueError(f"--workers must be at least 1, got {workers}")
    started = time.perf_counter()
    names = missing_scenes(out, scenes, first_seed, settings)
    try:
        for _ in track(write_scenes(out, names, settings, workers), "scenes", total=len(names)):
            pass
    except BrokenProcessPool as error:
        raise OSError(
            "a process was killed (too little memory?); finished scenes are kept, run the command again"
        ) from error
    except KeyboardInterrupt:
        raise SystemExit("interrupted; finished scenes are kept, run the command again to continue") from None
    seconds = time.perf_counter() - started
    print(
        f"{out}: wrote {len(names)} scenes of {settings.frames} frames in {seconds:.0f} s, "
        f"{scenes - len(names)} were there; use them: vg2gt train data=rgbd data.root={out}"
    )


def splits(argv: Sequence[str] | None = None) -> None:
    """Divides the scenes of a dataset into training and evaluation lists."""
    given, overrides = separate(argv)
    parser = flag_parser("data splits", DATA_COMMANDS["splits"], SPLITS)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="where train.txt and val.txt are written")
    add("--fraction", type=float, default=0.1, metavar="X", help="share of the places for val.txt, default 0.1; of "
        "every part of a mixture")  # fmt: skip
    add("--seed", type=int, default=0, metavar="N", help="another seed, another division")
    options = parser.parse_args(given)
    with errors_in_one_line():
        from hydra.utils import instantiate

        from vg2gt.data.splits import write_splits

        source = instantiate(compose("train", *overrides).data).train_source()
        for path in write_splits(options.out.expanduser(), source, options.fraction, options.seed):
            print(f"{path}: {len(path.read_text().splitlines()) - 1} scenes")


def views(argv: Sequence[str] | None = None) -> None:
    """Writes an index of views: which views of which scenes an evaluation takes."""
    given, overrides = separate(argv)
    parser = flag_parser("data views", DATA_COMMANDS["views"], VIEWS)
    parser.add_argument("--out", required=True, metavar="FILE.json", help="the index to write")
    with errors_in_one_line():
        print(write_views(parser.parse_args(given).out, overrides))


def write_views(out: str, overrides: Sequence[str]) -> Path:
    """Writes the index that the overrides of ``vg2gt evaluate`` ask for; returns its path."""
    from hydra.utils import instantiate

    from vg2gt.data.views.drawn import make_index
    from vg2gt.evaluation.run import view_counts
    from vg2gt.io.files import write_text

    if not out.endswith(".json"):
        raise ValueError(f"give the index file to write, --out FILE.json, got {out}")
    config = compose("evaluate", "output_dir=.", "name=index", *overrides)
    evaluation = instantiate(config.evaluation, _convert_="all")
    datamodule: SceneDataModule = instantiate(config.data)
    source = datamodule.evaluation_data().source
    scenes = list(source.scenes)[: datamodule.eval_scenes]
    index = make_index(evaluation.selection, source, scenes, view_counts(config.views))
    # One line per list of frames: readable, and a change of one draw is a change of one line.
    text = re.sub(r"\[[^\[\]{}]*\]", lambda found: re.sub(r"\s+", " ", found[0]), json.dumps(index, indent=1))
    return write_text(out, text.replace("[ ", "[").replace(" ]", "]") + "\n")
