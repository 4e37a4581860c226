"""Command-line arguments: flags of the commands, and Hydra's ``key=value`` for model, backend, renderer and data."""

from __future__ import annotations

import argparse
import glob
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from vg2gt.cli import folders
from vg2gt.cli.commands import COMMANDS, DATA_COMMANDS
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.config import config_dir
from vg2gt.io.files import by_number

if TYPE_CHECKING:
    from vg2gt.viewer.live import LiveView

folders.register()

_OVERRIDE = re.compile(r"(\+\+?|~)?[A-Za-z_][\w./]*=")
MODES = ("solid", "rasterized")
WATCH = "serve a page that shows the scene meanwhile"
GROUPS = (
    "hydra.help.template='$APP_CONFIG_GROUPS\n\nkey=value changes a key; --cfg job prints all keys with their values.'"
)


def hydra_command(name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorator that turns a function of the configuration ``NAME.yaml`` into a Hydra command, with sweeps."""
    command = COMMANDS[name]

    def decorate(run: Callable[[DictConfig], None]) -> Callable[[], None]:
        """Returns the command that runs the function."""

        @wraps(run)
        def job(config: DictConfig) -> None:
            with errors_in_one_line():
                run(config)

        @wraps(run)
        def main() -> None:
            """Composes the configuration with Hydra, which also reports wrong arguments, and runs the job."""
            if {"-h", "--help"} & set(sys.argv):
                print(f"{command.does}\n\nexample: {command.example}\n")
                sys.argv.append(GROUPS)
            with errors_in_one_line():
                hydra.main(version_base="1.3", config_path=config_dir(), config_name=name)(job)()

        return main

    return decorate


@contextmanager
def watching(wanted: bool) -> Iterator[LiveView | None]:
    """Serves a page that shows a scene while it is refined, until the end of the block, and prints its address."""
    if not wanted:
        yield None
        return
    from vg2gt.viewer.live import LiveView

    view = LiveView()
    print(f"watch the refinement at {view.address}", file=sys.stderr)
    try:
        yield view
    finally:
        view.close()


def flag_parser(name: str, details: str = "", usage: str | None = None) -> argparse.ArgumentParser:
    """Creates the parser of a command with flags; its help ends with the example and ``details``."""
    command = (COMMANDS | {f"data {each}": found for each, found in DATA_COMMANDS.items()})[name]
    return argparse.ArgumentParser(
        f"vg2gt {name}",
        usage=usage,
        description=f"{command.does[0].upper()}{command.does[1:]}.",
        epilog=f"example: {command.example}\n{details}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_common_flags(add: Callable[..., Any], saved: Sequence[str], outputs: Mapping[str, str]) -> None:
    """Adds the flags of all commands that render, by ``add_argument`` of a parser or a group.

    Args:
        add: adds a flag.
        saved: the default of ``--save``.
        outputs: the names that ``--save`` takes, with their descriptions.
    """
    names = "files to write, separated by commas; --save help lists all"
    add("--save", type=_saved(outputs), default=list(saved), metavar="LIST", help=f"{names}; default: "
        + ", ".join(saved))  # fmt: skip
    add(
        "--mode",
        choices=MODES,
        default=MODES[0],
        metavar="MODE",
        help="rendering: solid (default) or rasterized (as 3DGS)",
    )
    add("--device", default="auto", metavar="NAME", help="auto (default), cpu, cuda or cuda:N")
    add("--overwrite", action="store_true", help="replace existing outputs")
    add("--quiet", action="store_true", help="show no progress bars")


def _saved(outputs: Mapping[str, str]) -> Callable[[str], list[str]]:
    def names(text: str) -> list[str]:
        if text == "help":
            print("\n".join(f"{name:<13} {does}" for name, does in outputs.items()))
            sys.exit()
        return list_of_names(text)

    return names


def separate(argv: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Splits a command line into flags and ``key=value`` overrides; existing files of that form are no overrides."""
    given = sys.argv[1:] if argv is None else list(argv)
    overrides = [argument for argument in given if _OVERRIDE.match(argument) and not Path(argument).exists()]
    return [argument for argument in given if argument not in overrides], overrides


def without_patterns(paths: Sequence[str]) -> list[str]:
    """Returns paths; patterns such as ``photos/*.jpg``, which shells of Windows do not expand, become files."""
    found: list[str] = []
    for path in paths:
        is_pattern = glob.has_magic(path) and not Path(path).expanduser().exists()
        matches = sorted(glob.glob(str(Path(path).expanduser())), key=by_number) if is_pattern else []
        found += matches or [path]
    return found


def list_of_names(text: str) -> list[str]:
    """Splits ``a,b,c``."""
    return [name.strip() for name in text.split(",") if name.strip()]
