"""``vg2gt data splits | views | stream``: prepares lists of scenes and views, and streams, of a dataset."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.cli.arguments import flag_parser, separate
from vg2gt.cli.commands import DATA_COMMANDS, dispatch
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.config import compose

if TYPE_CHECKING:
    from vg2gt.data.datamodule import SceneDataModule

_SPLITS = """
key=value arguments choose the dataset as in vg2gt train; the scenes of data.train are split; recordings of one place
stay together. Use the lists with data.train.scenes=DIR/train.txt data.val.scenes=DIR/val.txt"""
VIEWS = """
key=value arguments are those of vg2gt evaluate: the data, its scenes (data.eval_scenes), the numbers of views and how
they are drawn (evaluation.selection). Use the file with evaluation.selection.index=FILE.json. The same arguments and
data give the same file."""
STREAM = """
key=value arguments choose the dataset as in vg2gt train. Frames are resized to data.image_size. Train from them with
data=stream data.root=DIR data.image_size=[H,W] (the same size)"""


def main() -> None:
    """Runs ``vg2gt data COMMAND [arguments]``."""
    dispatch("vg2gt data", DATA_COMMANDS)


def splits(argv: Sequence[str] | None = None) -> None:
    """Divides the scenes of a dataset into training and evaluation lists."""
    given, overrides = separate(argv)
    parser = flag_parser("data splits", _SPLITS)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="where train.txt and val.txt are written")
    add("--fraction", type=float, default=0.1, metavar="X", help="fraction of the places for val.txt, default 0.1")
    add("--seed", type=int, default=0, metavar="N", help="random seed of the split, default 0")
    options = parser.parse_args(given)
    with errors_in_one_line():
        from hydra.utils import instantiate

        from vg2gt.data.splits import write_splits

        source = instantiate(compose("train", *overrides).data).train_source()
        for path in write_splits(options.out.expanduser(), source, options.fraction, options.seed):
            print(f"{path}: {len(path.read_text().splitlines()) - 1} scenes")


def views(argv: Sequence[str] | None = None) -> None:
    """Writes an index of the scenes and views that an evaluation uses."""
    given, overrides = separate(argv)
    parser = flag_parser("data views", VIEWS)
    parser.add_argument("--out", required=True, metavar="FILE.json", help="the index to write")
    with errors_in_one_line():
        print(write_views(parser.parse_args(given).out, overrides))


def stream(argv: Sequence[str] | None = None) -> None:
    """Writes the training and evaluation scenes of a dataset as two streams."""
    given, overrides = separate(argv)
    parser = flag_parser("data stream", STREAM)
    parser.add_argument("--out", required=True, metavar="DIR", help="folder or address, such as s3://bucket/scans")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes, default 1")
    options = parser.parse_args(given)
    with errors_in_one_line():
        from hydra.utils import instantiate

        from vg2gt.data.sources.streamed import write_stream

        data: SceneDataModule = instantiate(compose("train", *overrides).data)
        sources = {"train": (data.train_source(), data.train_scenes), "val": (data.val_source(), data.eval_scenes)}
        for split, (source, limit) in sources.items():
            out = f"{options.out.rstrip('/')}/{split}"
            scenes = list(source.scenes)[:limit]
            write_stream(source, scenes, data.prepare, out, options.workers)
            print(f"{out}: {len(scenes)} scenes, {sum(len(source.frames(scene)) for scene in scenes)} frames")


def write_views(out: str, overrides: Sequence[str]) -> Path:
    """Writes the index of views for overrides of ``vg2gt evaluate``; returns its path."""
    from hydra.utils import instantiate

    from vg2gt.data.views.drawn import make_index
    from vg2gt.evaluation.run import view_counts
    from vg2gt.io.files import write_text

    if not out.endswith(".json"):
        raise ValueError(f"--out must be a .json file, got {out}")
    config = compose("evaluate", "output_dir=.", "name=index", *overrides)
    evaluation = instantiate(config.evaluation, _convert_="all")
    datamodule: SceneDataModule = instantiate(config.data)
    source = datamodule.evaluation_data().source
    scenes = list(source.scenes)[: datamodule.eval_scenes]
    index = make_index(evaluation.selection, source, scenes, view_counts(config.views))
    # one line per list of frames, for readable diffs
    text = re.sub(r"\[[^\[\]{}]*\]", lambda found: re.sub(r"\s+", " ", found[0]), json.dumps(index, indent=1))
    return write_text(out, text.replace("[ ", "[").replace(" ]", "]") + "\n")
