"""``vg2gt reconstruct CAPTURE ... --each``: many captures, each a job of a Hydra sweep.

Hydra's launchers run the jobs: one after another by default, in local processes (``hydra/launcher=joblib``), on SLURM
(``submitit_slurm``) or elsewhere. ``DIR/captures`` holds the plan and the log, ``DIR/NAME/capture.json`` the result of
a capture. What is done is not repeated, and a capture that fails does not stop the others.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vg2gt.cli.errors import USER_ERRORS
from vg2gt.config import config_dir
from vg2gt.evaluation.tables import markdown_table
from vg2gt.io.files import read_json, write_json, write_text
from vg2gt.outputs.output_names import check_outputs

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

    Run = Callable[[argparse.Namespace, Sequence[str]], Scene]

log = logging.getLogger(__name__)

_PLACE, _PLAN, _RESULT, TABLE = "captures", "plan.json", "capture.json", "captures.md"
_MAY_DIFFER = ("images", "out", "overwrite", "quiet", "watch", "device")  # may differ when the command is given again
STARTED, _DONE, _FAILED = "started", "done", "failed"


def reconstruct_each(options: argparse.Namespace, overrides: Sequence[str], run: Run) -> None:
    """Reconstructs every capture into ``DIR/NAME``; prints and writes ``captures.md``.

    Args:
        options: the flags of ``vg2gt reconstruct``; ``images`` are the captures.
        overrides: ``key=value``, those of Hydra's launcher among them.
        run: reconstructs one scene with such options and overrides.

    Raises:
        FileExistsError: if the folder holds captures that were reconstructed with other options.
        ValueError: if two captures have the same name, or an output is unknown.
        SystemExit: if captures failed.
    """
    check_outputs(options.save)
    folder = Path(options.out).expanduser().absolute()
    captures = _named(options.images)
    of_hydra = [each for each in overrides if each.lstrip("+~").startswith("hydra")]
    given = vars(options) | {"overrides": [each for each in overrides if each not in of_hydra]}
    plan = folder / _PLACE / _PLAN
    if not options.overwrite:
        _refuse_other(plan, given)
    write_json(plan, {"options": given, "captures": captures})
    before = [_result(folder / name).get("status") for name in captures]
    todo = [number for number, status in enumerate(before) if options.overwrite or status != _DONE]
    todo.sort(key=lambda number: before[number] == STARTED)  # last, as one of them may have ended the process

    def job(config: DictConfig) -> None:
        _reconstruct(Path(HydraConfig.get().sweep.dir), config.capture, run)

    if todo:
        where = str(plan.parent).replace("'", "\\'")
        jobs = [f"+capture={','.join(map(str, todo))}", f"hydra.sweep.dir='{where}'", "hydra.sweep.subdir=."]
        quiet = ["hydra.output_subdir=null", "hydra/job_logging=quiet", "hydra/hydra_logging=none"]
        logging.getLogger("hydra").setLevel(logging.WARNING)
        sys.argv[1:] = ["-m", *jobs, *quiet, *of_hydra]  # Hydra reads them there
        hydra.main(version_base="1.3", config_path=config_dir(), config_name=None)(job)()
    results = {name: _result(folder / name) for name in captures}
    print(write_text(folder / TABLE, _table(results)).read_text(), end="")
    failed = [name for name, result in results.items() if result.get("status") != _DONE]
    if failed:
        sys.exit(
            f"{len(failed)} of {len(captures)} captures failed: {', '.join(failed)}; the same command repeats them"
        )


def _reconstruct(place: Path, number: int, run: Run) -> None:
    """Reconstructs one capture of the plan in a folder and writes its result."""
    plan = read_json(place / _PLAN)
    name, images = list(plan["captures"].items())[number]
    out = place.parent / name
    options = argparse.Namespace(**plan["options"] | {"images": [images], "out": str(out), "quiet": True})
    options.size = tuple(options.size) if isinstance(options.size, list) else options.size
    options.overwrite = options.overwrite or bool(_result(out))  # what an earlier attempt has left
    write_json(out / _RESULT, {"status": STARTED})
    begin = time.monotonic()
    print(f"\n{name}")
    try:
        scene = run(options, options.overrides)
        result: dict[str, Any] = {"status": _DONE, "images": len(scene.names), "gaussians": len(scene.gaussians)}
    except Exception as error:  # whatever it is, the other captures go on
        if isinstance(error, USER_ERRORS):
            log.error("%s: %s", name, error)
        else:
            log.exception("%s failed", name)
        result = {"status": _FAILED, "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    write_json(out / _RESULT, result | {"seconds": time.monotonic() - begin})


def _named(images: Sequence[str]) -> dict[str, str]:
    """Absolute paths of the captures by name, sorted; lines of a text file are captures too."""
    listed: list[Path] = []
    for path in (Path(image).expanduser() for image in images):
        if path.suffix == ".txt" and path.is_file():
            lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
            listed += [path.parent / Path(line).expanduser() for line in lines if line]
        else:
            listed.append(path)
    found: dict[str, str] = {}
    for path in (each.absolute() for each in listed):
        name = path.stem if path.is_file() else path.name
        if name in (*found, _PLACE):
            raise ValueError(f"{found.get(name, _PLACE)} and {path} would both be written to {name}: rename one")
        found[name] = str(path)
    return dict(sorted(found.items()))  # the order of the plan


def _refuse_other(path: Path, options: dict[str, Any]) -> None:
    """Raises FileExistsError if the plan in a folder has other options."""
    now = json.loads(json.dumps(options))  # lists for tuples
    before = read_json(path)["options"] if path.is_file() else now
    if other := [name for name, value in now.items() if name not in _MAY_DIFFER and value != before.get(name)]:
        raise FileExistsError(
            f"{path.parent.parent} holds captures made with other options ({', '.join(other)}): repeat them, choose "
            "another --out, or replace all with --overwrite"
        )


def _result(folder: Path) -> dict[str, Any]:
    """The result of a capture; empty if it was never started."""
    path = folder / _RESULT
    return read_json(path) if path.is_file() else {}


def _table(results: dict[str, dict[str, Any]]) -> str:
    head = ("capture", "status", "images", "Gaussians", "seconds")
    rows = [
        [
            name,
            result.get("status", "not started"),
            *(str(result.get(key, "")) for key in ("images", "gaussians")),
            f"{result['seconds']:.1f}" if "seconds" in result else "",
        ]
        for name, result in results.items()
    ]
    errors = [f"\n{name}: {result['error']}\n" for name, result in results.items() if "error" in result]
    return markdown_table(head, rows, text_columns=2) + "\n" + "".join(errors)
