"""A training step of two checkouts side by side: ``python benchmarks/before_after.py --before FOLDER [overrides]``.

``git worktree add FOLDER COMMIT`` makes such a folder; ``--after`` is this checkout unless said otherwise. Two
processes, each with the allocator as that checkout's ``train.py`` sets it, take three steps in turns on the same
scenes, so that whatever else the machine does meets both; as in training, no set of views comes twice. The first step
of a turn is not counted: while the other side is at work, the allocator gives memory back that it would keep in
training. Every checkout has its own defaults, numbers of views and the optimiser among them, unless overrides say
otherwise. Loading views is not counted.
Prints processor time, the ratio of the means and the median of the pairs' ratios, peak memory and page faults, and
writes them as a dated JSON file.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
TURN = 3  # steps in a row; the first turn is for warming up
SCENES = 12


def serve(overrides: list[str], threads: int) -> None:
    """Takes a step whenever a line arrives and answers with seconds forward, backward, loss, peak and page faults."""
    sys.path[0] = str(Path(os.environ["PYTHONPATH"]) / "benchmarks")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    with suppress(ImportError, AttributeError):  # of commits before mimalloc
        importlib.import_module("vg2gt.cli.allocator").give_back_large_blocks()
    import torch
    from common import training_step

    from vg2gt.studies.study import compose_run
    from vg2gt.training.loop import build

    torch.set_num_threads(threads)
    with tempfile.TemporaryDirectory() as folder:
        run = build(compose_run([f"data.train_scenes={SCENES}", *overrides], Path(folder)))
        run.datamodule.setup("fit")
        step_loss, loader = training_step(run), iter(run.datamodule.train_dataloader())
        named = [(name, p) for name, p in run.module.model.named_parameters() if p.requires_grad]
        optimizer = run.module.make_optimizer(named)
        for group in optimizer.param_groups:
            group["lr"] = 1e-4
        print("ready", file=answers, flush=True)
        for _ in sys.stdin:
            batch = next(loader)
            faults, start = page_faults(), time.process_time()
            loss = step_loss(batch)
            middle = time.process_time()
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            figures = (middle - start, time.process_time() - middle, float(loss.detach()))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            print(*figures, peak, page_faults() - faults, file=answers, flush=True)


def page_faults() -> int:
    """Pages that this process has been given so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


class Side:
    """A process that takes steps of one checkout.

    Attributes:
        rows: of every step that counts: seconds forward, seconds backward, loss, peak MB so far, page faults.
    """

    def __init__(self, checkout: Path, arguments: list[str], threads: int) -> None:
        self.rows: list[list[float]] = []
        variables = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(threads)}
        self.process = subprocess.Popen(
            [sys.executable, __file__, "serve", str(threads), *arguments],
            env={**variables, **_allocator(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answer()

    def step(self, counts: bool) -> None:
        """Takes one step."""
        assert self.process.stdin is not None
        print("step", file=self.process.stdin, flush=True)
        row = [float(figure) for figure in self._answer().split()]
        if counts:
            self.rows.append(row)

    def seconds(self) -> list[float]:
        """Processor time of every step."""
        return [row[0] + row[1] for row in self.rows]

    def summary(self) -> dict[str, float]:
        """Means over the steps."""
        forward, backward, loss, _, faults = map(statistics.fmean, zip(*self.rows, strict=True))
        return {
            "step_core_seconds": forward + backward,
            "forward_core_seconds": forward,
            "backward_core_seconds": backward,
            "loss": loss,
            "peak_mb": self.rows[-1][3],
            "page_faults": faults,
        }

    def _answer(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a side ended with exit status {self.process.wait()}; what it said stands above")
        return line


def _allocator(checkout: Path) -> dict[str, str]:
    """Variables by which a checkout's commands replace the allocator."""
    code = "import json, vg2gt.cli.allocator as found; print(json.dumps(found.mimalloc_environment()))"
    command = [sys.executable, "-c", code]  # finds the package in the folder where it runs
    asked = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    return json.loads(asked.stdout) if asked.returncode == 0 else {}


def commit(checkout: Path) -> str:
    """Its commit, with a plus sign where files differ from it."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def compare(before: Path, after: Path, steps: int, threads: int, overrides: list[str]) -> dict[str, Any]:
    """Takes the steps and returns what is written."""
    sides = {name: Side(path, overrides, threads) for name, path in (("before", before), ("after", after))}
    turns = 1 + -(-steps // (TURN - 1))
    for turn in range(turns):
        for side in list(sides.values())[:: 1 if turn % 2 else -1]:
            for step in range(TURN):
                side.step(counts=turn > 0 and step > 0)
    summaries = {name: side.summary() for name, side in sides.items()}
    pairs = zip(sides["before"].seconds(), sides["after"].seconds(), strict=True)
    return {
        "before": {"commit": commit(before), **summaries["before"]},
        "after": {"commit": commit(after), **summaries["after"]},
        "ratio": summaries["after"]["step_core_seconds"] / summaries["before"]["step_core_seconds"],
        "median_of_pairs": statistics.median(late / early for early, late in pairs),
        "steps": len(sides["after"].rows),
        "threads": threads,
        "overrides": overrides,
    }


def main() -> None:
    """Measures, prints and writes."""
    from common import machine, parser, write_results

    from vg2gt.evaluation.tables import print_table

    options = parser(__doc__, threads=1, overrides="Hydra overrides")
    options.add_argument("--before", type=Path, required=True, help="a checkout")
    options.add_argument("--after", type=Path, default=HERE, help="another; this one by default")
    options.add_argument("--steps", type=int, default=24)
    options.add_argument("--name", default="step-before-after", help="of the file, after the date")
    arguments = options.parse_args()
    sides = [path.resolve() for path in (arguments.before, arguments.after)]
    found = compare(sides[0], sides[1], arguments.steps, arguments.threads, arguments.overrides)
    rows = [[name, *(f"{found[side][name]:.4g}" for side in ("before", "after"))] for name in list(found["after"])[1:]]
    ratios = f"ratio {found['ratio']:.3f}, median of pairs {found['median_of_pairs']:.3f}"
    print_table(("", found["before"]["commit"], found["after"]["commit"]), rows, title=ratios)
    write_results(arguments.out, arguments.name, {**found, "machine": machine()})


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(sys.argv[3:], int(sys.argv[2]))
    else:
        main()
