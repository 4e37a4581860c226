"""``vg2gt data views evaluation=rgbd data.root=FOLDER out=FILE.json``: makes an index of views.

All arguments but ``out`` are those of ``python -m vg2gt.evaluate``; they say which data, which scenes
(``data.eval_scenes``), which numbers of views and how they are drawn (``evaluation.selection``). The file is then read
with ``evaluation.selection.index=FILE.json``. Equal arguments and data give equal files.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf.errors import OmegaConfBaseException

from vg2gt.config import config_dir
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.data.views.drawn import make_index
from vg2gt.evaluation.options import EvaluationOptions
from vg2gt.evaluation.run import view_counts
from vg2gt.io.files import write_text

FIXED = ["output_dir=.", "name=index", "hydra/job_logging=default"]


def write_views(arguments: Sequence[str]) -> Path:
    """Writes the index that the arguments ask for; returns its path.

    Raises:
        ValueError: if ``out`` is missing or an argument is wrong.
        DataError: if a scene has too few frames.
    """
    out = [argument.removeprefix("out=") for argument in arguments if argument.startswith("out=")]
    if len(out) != 1 or not out[0].endswith(".json"):
        raise ValueError("give the index file to write, out=FILE.json")
    overrides = [argument for argument in arguments if not argument.startswith("out=")]
    try:
        with initialize_config_dir(config_dir(), version_base="1.3"):
            config = compose("evaluate", [*FIXED, *overrides])
        options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
        datamodule: SceneDataModule = instantiate(config.data)
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(str(error)) from error
    source = datamodule.evaluation_data().source
    scenes = list(source.scenes)[: datamodule.eval_scenes]
    index = make_index(options.selection, source, scenes, view_counts(config.views))
    # One line a list of frames: readable, and a change of one draw is a change of one line.
    text = re.sub(r"\[[^\[\]{}]*\]", lambda found: re.sub(r"\s+", " ", found[0]), json.dumps(index, indent=1))
    return write_text(out[0], text.replace("[ ", "[").replace(" ]", "]") + "\n")


def main() -> None:
    """Runs the command with the process's arguments."""
    try:
        print(write_views(sys.argv[1:]))
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
