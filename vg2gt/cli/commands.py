"""All commands of ``vg2gt``: entry points, descriptions and examples. Imports none of them, to keep help fast."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches

import vg2gt


@dataclass(frozen=True)
class Command:
    """A command: its ``module:function``, a one-line description and an example."""

    entry: str
    does: str
    example: str


COMMANDS = {
    "train": Command(
        "vg2gt.cli.train:main",
        "trains and evaluates a model; the same as python train.py",
        "vg2gt train name=first trainer.max_steps=200",
    ),
    "evaluate": Command(
        "vg2gt.cli.evaluate:main",
        "measures a checkpoint on a data set",
        "vg2gt evaluate ckpt=outputs/quickstart data=synthetic 'views=[3,10,20]'",
    ),
    "calibrate": Command(
        "vg2gt.cli.calibrate:main",
        "calibrates the depth error bounds of a checkpoint",
        "vg2gt calibrate ckpt=outputs/quickstart data=synthetic data.eval_scenes=48",
    ),
    "ablate": Command(
        "vg2gt.cli.ablate:main",
        "trains and compares the paper's ablations over seeds",
        "vg2gt ablate seeds=3 steps=100",
    ),
    "reconstruct": Command(
        "vg2gt.cli.reconstruct:main",
        "reconstructs a scene of Gaussians from images, a folder or a video",
        "vg2gt reconstruct photos/ backend=da3_small --out outputs/photos",
    ),
    "refine": Command(
        "vg2gt.cli.refine:main",
        "optimises a reconstructed scene on its own images",
        "vg2gt refine outputs/photos --seconds 60 --holdout 8",
    ),
    "render": Command(
        "vg2gt.cli.render:main",
        "renders a scene from the cameras of a cameras.json",
        "vg2gt render scene.ply --cameras cameras.json --save color.png --out views",
    ),
    "view": Command(
        "vg2gt.cli.view:main",
        "shows a scene in the browser, live or as one page",
        "vg2gt view scene.ply --cameras cameras.json --html scene.html",
    ),
    "export": Command(
        "vg2gt.cli.export:main",
        "writes a frozen network as an ONNX bundle",
        "vg2gt export backend=da3_small --out bundles/da3_small",
    ),
    "data": Command(
        "vg2gt.cli.data:main",
        "makes splits and lists of views",
        "vg2gt data splits data=rgbd data.root=RECORDINGS --out lists",
    ),
    "doctor": Command(
        "vg2gt.cli.doctor:main",
        "checks this machine: packages, devices, renderer, correctness of the kernels",
        "vg2gt doctor",
    ),
}

DATA_COMMANDS = {
    "splits": Command(
        "vg2gt.cli.data:splits",
        "splits a dataset's scenes into training and evaluation lists",
        "vg2gt data splits data=rgbd data.root=RECORDINGS --out lists",
    ),
    "views": Command(
        "vg2gt.cli.data:views",
        "draws the views of an evaluation and writes an index",
        "vg2gt data views evaluation=rgbd data.root=RECORDINGS --out views.json",
    ),
}


def dispatch(program: str, commands: Mapping[str, Command]) -> None:
    """Runs ``program COMMAND [arguments]``; lists all commands if none is given, suggests one if it is unknown."""
    asked = sys.argv[1] if len(sys.argv) > 1 else ""
    if asked in ("", "-h", "--help"):
        print(listing(program, commands))
        sys.exit(0 if asked else 2)
    if asked == "--version":
        print(f"vg2gt {vg2gt.__version__}")
        return
    if asked not in commands:
        near = get_close_matches(asked, commands, 1)
        advice = f", did you mean {near[0]}?" if near else ""
        print(f"{program}: unknown command {asked!r}{advice} ({program} --help lists all)", file=sys.stderr)
        sys.exit(2)
    module, _, function = commands[asked].entry.partition(":")
    command = importlib.import_module(module)
    # DDP starts further processes from argv: argv[0] must be the command's own file, and its name must not follow
    sys.argv[:2] = [str(command.__file__)]
    getattr(command, function)()


def listing(program: str, commands: Mapping[str, Command]) -> str:
    """Lists the commands, each with a description and an example."""
    lines = [f"usage: {program} COMMAND [arguments]", ""]
    for name, command in commands.items():
        lines += [f"  {name:<12} {command.does}", f"  {'':<12}   {command.example}"]
    return "\n".join([*lines, "", f"{program} COMMAND --help explains one of them."])
