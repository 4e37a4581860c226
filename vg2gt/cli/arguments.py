"""Three kinds of arguments: a configuration's (Hydra), ``key=value`` pairs of a command's own, and flags."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import wraps
from inspect import cleandoc
from typing import Any, TypeVar

import hydra
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vg2gt.cli import folders
from vg2gt.cli.commands import Command
from vg2gt.cli.errors import TRACEBACK, errors_in_one_line
from vg2gt.config import config_dir, near_keys

folders.register()

Options = TypeVar("Options")
HELP = {"-h", "--help"}


def hydra_command(command: Command, config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Makes a command of a function of a configuration, with sweeps and a folder for the run.

    Args:
        command: what its help says first.
        config_name: of the configuration that the arguments change.
    """

    def decorate(run: Callable[[DictConfig], None]) -> Callable[[], None]:
        """The command that runs this function."""

        @wraps(run)
        def main() -> None:
            """The command: Hydra composes the configuration, and errors are one line."""
            asked = os.environ.get(TRACEBACK)

            @wraps(run)
            def job(config: DictConfig) -> None:
                _show_tracebacks(asked)
                with errors_in_one_line():
                    run(config)

            if HELP & set(sys.argv):
                print(f"{command.does}\n\nexample: {command.example}\n")
            with errors_in_one_line():
                try:
                    _show_tracebacks("1")  # else Hydra itself ends the process, with many lines about an argument
                    hydra.main(version_base="1.3", config_path=config_dir(), config_name=config_name)(job)()
                except ConfigCompositionException as error:
                    if advice := near_keys(config_name, sys.argv[1:], error):
                        raise ValueError(advice) from error
                    raise
                finally:
                    _show_tracebacks(asked)

        return main

    return decorate


def _show_tracebacks(value: str | None) -> None:
    os.environ.pop(TRACEBACK, None)
    if value is not None:
        os.environ[TRACEBACK] = value


def key_value_command(command: Command) -> Callable[[Callable[[list[str]], None]], Callable[..., None]]:
    """Makes a command of a function of ``key=value`` arguments; its help is the function's docstring."""

    def decorate(run: Callable[[list[str]], None]) -> Callable[..., None]:
        """The command that runs this function."""

        @wraps(run)
        def main(arguments: Sequence[str] | None = None) -> None:
            given = sys.argv[1:] if arguments is None else list(arguments)
            if not given or HELP & set(given):
                print(f"{cleandoc(run.__doc__ or '')}\n\nexample: {command.example}")
                sys.exit(0 if given else 2)
            with errors_in_one_line():
                run(given)

        return main

    return decorate


def read_options(schema: type[Options], arguments: Sequence[str]) -> tuple[Options, list[str]]:
    """Reads a command's own ``key=value`` arguments.

    Args:
        schema: a dataclass of them; what is ``MISSING`` must be given.
        arguments: of the command.

    Returns:
        The options, and the arguments that are none of them.

    Raises:
        ValueError: naming the option that is missing or of the wrong type.
    """
    names = {field.name for field in fields(schema)}  # pyright: ignore[reportArgumentType]
    own = [argument for argument in arguments if "=" in argument and argument.partition("=")[0] in names]
    try:
        options = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.from_dotlist(own)))
    except OmegaConfBaseException as error:
        if "Missing mandatory value" in str(error) or "MissingMandatoryValue" in type(error).__name__:
            raise ValueError(f"give {error.full_key}=") from error
        raise ValueError(f"option {error.full_key}: {str(error).splitlines()[0]}") from error
    return options, [argument for argument in arguments if argument not in own]  # pyright: ignore[reportReturnType]


def flag_parser(name: str, command: Command, details: str = "") -> argparse.ArgumentParser:
    """The parser of a command with flags; its help ends with the example and ``details``."""
    return argparse.ArgumentParser(
        f"vg2gt {name}",
        description=f"{command.does[0].upper()}{command.does[1:]}.",
        epilog=f"example: {command.example}\n{details}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def refuse_unknown(parser: argparse.ArgumentParser, unknown: Sequence[str]) -> None:
    """Ends the command where arguments are left; ``backend.key=value``, as ``vg2gt train`` takes it, gets a hint.

    Args:
        parser: of a command with ``--backend``, ``--model`` and ``--set``.
        unknown: the arguments that are none of its.
    """
    if not unknown:
        return
    hints = []
    for part, dot, change in (argument.partition(".") for argument in unknown if "=" in argument):
        if part in ("backend", "model") and dot:
            hints.append(f"--{part} NAME,{change}")
        else:
            hints.append(f"--set {part}{dot}{change}")
    advice = f" (write {' '.join(hints)})" if hints else ""
    parser.error(f"unrecognized arguments: {' '.join(unknown)}{advice}")


def list_of_names(text: str) -> list[str]:
    """Reads ``a,b,c``."""
    return [name.strip() for name in text.split(",") if name.strip()]


def listing(outputs: dict[str, Any]) -> str:
    """What ``--save`` takes, one name per line."""
    return "\n".join(["", "outputs of --save:", *(f"  {name:<13} {text}" for name, text in outputs.items())])
