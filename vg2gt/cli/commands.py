"""All commands of ``vg2gt``: descriptions and examples. Imports none of them, to keep help fast."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import vg2gt


@dataclass(frozen=True)
class Command:
    """A command: a one-line description and an example."""

    does: str
    example: str


COMMANDS = {
    "train": Command(
        "trains and evaluates a model; the same as python train.py", "vg2gt train name=first trainer.max_steps=200"
    ),
    "evaluate": Command(
        "measures a checkpoint on a data set", "vg2gt evaluate ckpt=outputs/quickstart data=synthetic 'views=[3,10,20]'"
    ),
    "calibrate": Command(
        "calibrates the depth error bounds of a checkpoint",
        "vg2gt calibrate ckpt=outputs/quickstart data=synthetic data.eval_scenes=48",
    ),
    "ablate": Command("trains and compares the paper's ablations over seeds", "vg2gt ablate seeds=3 steps=100"),
    "reconstruct": Command(
        "reconstructs a scene of Gaussians from images, a folder or a video",
        "vg2gt reconstruct photos/ backend=da3_small --out outputs/photos",
    ),
    "refine": Command(
        "optimises a reconstructed scene on its own images", "vg2gt refine outputs/photos --seconds 60 --holdout 8"
    ),
    "render": Command(
        "renders a scene from given cameras, or a video of it",
        "vg2gt render outputs/photos --orbit --size 1920x1080 --save video.mp4",
    ),
    "view": Command(
        "writes a scene as one page for the browser",
        "vg2gt view scene.ply --cameras cameras.json --open",
    ),
    "place": Command(
        "says how large a scene is, or where it is on the Earth",
        "vg2gt place outputs/photos --scale 0,0,1,0.5,0,1=1.2m",
    ),
    "export": Command(
        "writes a frozen network as an ONNX bundle", "vg2gt export backend=da3_small --out bundles/da3_small"
    ),
    "data": Command(
        "makes splits, lists of views and streams", "vg2gt data splits data=rgbd data.root=RECORDINGS --out lists"
    ),
    "doctor": Command("shows packages, devices and renderer; on a GPU, checks the renderer's kernels", "vg2gt doctor"),
}

DATA_COMMANDS = {
    "splits": Command(
        "splits a dataset's scenes into training and evaluation lists",
        "vg2gt data splits data=rgbd data.root=RECORDINGS --out lists",
    ),
    "views": Command(
        "draws the views of an evaluation and writes an index",
        "vg2gt data views evaluation=rgbd data.root=RECORDINGS --out views.json",
    ),
    "stream": Command(
        "writes a dataset as streams for training from object storage",
        "vg2gt data stream data=rgbd data.root=RECORDINGS --out s3://bucket/scans",
    ),
}


def dispatch(program: str, commands: Mapping[str, Command]) -> None:
    """Runs ``program COMMAND [arguments]``; lists all commands if none is given, suggests one if it is unknown.

    ``vg2gt COMMAND`` is ``main`` of the module of that name, ``vg2gt MODULE COMMAND`` a function of the module.
    """
    asked = sys.argv[1] if len(sys.argv) > 1 else ""
    if asked in ("", "-h", "--help"):
        print(_listing(program, commands))
        sys.exit(0 if asked else 2)
    if asked == "--version":
        print(f"vg2gt {vg2gt.__version__}")
        return
    if asked not in commands:
        near = get_close_matches(asked, commands, 1)
        advice = f", did you mean {near[0]}?" if near else ""
        print(f"{program}: unknown command {asked!r}{advice} ({program} --help lists all)", file=sys.stderr)
        sys.exit(2)
    module, function = (*program.split()[1:], asked, "main")[:2]
    command = importlib.import_module(f"vg2gt.cli.{module}")
    # DDP starts further processes from argv: argv[0] must be the command's own file, and its name must not follow
    rest = [f"./{each}" if each[0:1] == "-" and Path(each).exists() else each for each in sys.argv[2:]]  # no flags
    sys.argv[:] = [str(command.__file__), *rest]
    getattr(command, function)()


def _listing(program: str, commands: Mapping[str, Command]) -> str:
    """Lists the commands, each with a description and an example."""
    lines = [f"usage: {program} COMMAND [arguments]", ""]
    for name, command in commands.items():
        lines += [f"  {name:<12} {command.does}", f"  {'':<12}   {command.example}"]
    return "\n".join([*lines, "", f"{program} COMMAND --help explains one of them."])
