"""Everything there is to measure on a GPU, in about ten minutes: ``python benchmarks/gpu.py``.

The one command for those who have a GPU. Runs, each in a process of its own: ``vg2gt doctor`` (do the kernels agree
with the reference here), the renderer against torch's and gsplat's where that is installed (``render.py``), the stages
of a reconstruction and a training step beside the paper's (``stages.py``), peak memory against views (``memory.py``).
What a part wrote is collected into one dated JSON file and one Markdown file in ``benchmarks/results``, ready to
commit; a part that fails is told in them and holds up no other.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, write_results

from vg2gt.io.files import read_json, write_text

HERE = Path(__file__).resolve().parent
# the paper's modules at their sizes on a small backbone with random weights: what it costs does not depend on them
MODEL = ("backend=da3_small", "backend.pretrained=false", "model=vg2gt", "data=synthetic", "trainer=gpu")


@dataclass(frozen=True)
class Part:
    """One measurement.

    Attributes:
        name: in the results.
        command: after the interpreter; ``--out FOLDER`` is added to scripts.
        seconds: that it may take.
    """

    name: str
    command: tuple[str, ...]
    seconds: int


PARTS = (
    Part("doctor", ("-c", "from vg2gt.cli.doctor import main; main([])"), 120),
    Part("render", (str(HERE / "render.py"), "--device", "cuda", "--quick"), 180),
    Part(
        "stages",
        (str(HERE / "stages.py"), "--device", "cuda", "--training", "--views", "15", "--size", "224", "448", *MODEL),
        180,
    ),
    Part("memory", (str(HERE / "memory.py"), "--device", "cuda"), 180),
)


def measure(part: Part) -> dict[str, Any]:
    """Runs a part; returns what it printed, its result files' contents, and how it ended."""
    with tempfile.TemporaryDirectory() as folder:
        # options come before the Hydra overrides, which take all that is left
        first, *rest = part.command
        out = [] if first == "-c" else ["--out", folder]
        try:
            done = subprocess.run(
                [sys.executable, first, *out, *rest],
                capture_output=True, text=True, check=False, timeout=part.seconds,
            )  # fmt: skip
            ended = "done" if done.returncode == 0 else f"failed: {(done.stderr.strip() or 'no message')[-500:]}"
            shown = done.stdout
        except subprocess.TimeoutExpired as error:
            ended = f"stopped after {part.seconds} s"
            shown = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        results = [read_json(path) for path in sorted(Path(folder).glob("*.json"))]
    return {"ended": ended, "shown": shown, "results": results}


def markdown(where: dict[str, Any], found: dict[str, dict[str, Any]]) -> str:
    """The machine, and what every part printed."""
    lines = ["# Measured on a GPU", "", f"`{json.dumps(where)}`"]
    for name, part in found.items():
        lines += ["", f"## {name}: {part['ended']}", "", "```", part["shown"].strip(), "```"]
    return "\n".join([*lines, ""])


def main(argv: Sequence[str] | None = None) -> None:
    """Measures and writes.

    Raises:
        SystemExit: where there is no GPU.
    """
    options = parser(__doc__)
    options.add_argument("--parts", nargs="+", choices=[part.name for part in PARTS], metavar="NAME")
    arguments = options.parse_args(argv)
    if not torch.cuda.is_available():
        sys.exit("benchmarks/gpu.py needs a GPU that torch can use; python benchmarks/gpu_step.py counts without one")
    where, found = machine("cuda"), {}
    for part in PARTS:
        if arguments.parts and part.name not in arguments.parts:
            continue
        print(f"{part.name} (at most {part.seconds} s) ...", flush=True)
        found[part.name] = measure(part)
        print(found[part.name]["shown"], found[part.name]["ended"], flush=True)
        path = write_results(arguments.out, "gpu", {"machine": where, "parts": found})
        write_text(path.with_suffix(".md"), markdown(where, found))


if __name__ == "__main__":
    main()
