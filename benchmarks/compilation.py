"""What compiling the kernels of a first training takes: ``python benchmarks/compilation.py --before FOLDER``.

Two checkouts in turns, on the built-in rooms, kernels kept in a folder that begins empty. "In one process": processor
time of one batch and one step in a process on one thread, minus that in a second process, which finds the kernels.
"In processes of their own": processor time of all processes that ``train.py`` compiles in, the step that one of them
takes included; none for a checkout whose trainings compile themselves.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
STEP = """
import sys, tempfile, time
from pathlib import Path
import torch
from common import training_step
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import build
torch.set_num_threads(1)
with tempfile.TemporaryDirectory() as folder:
    run = build(compose_run([f"data.cache_dir={folder}"], Path(folder)))
    run.datamodule.setup("fit")
    start = time.process_time()
    training_step(run)(next(iter(run.datamodule.train_dataloader()))).backward()
    print("seconds", time.process_time() - start)
"""
TRAINING = """
import resource, sys
from vg2gt.cli.train import main
from vg2gt.training import loop
compile_kernels = getattr(loop, "compile_kernels", None)
def compiled(*given, **options):
    compile_kernels(*given, **options)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print("seconds", used.ru_utime + used.ru_stime, flush=True)
    raise SystemExit(0)
if compile_kernels:
    loop.compile_kernels = compiled
    main()
"""


def seconds(checkout: Path, code: str, kernels: Path, *arguments: str) -> float | None:
    """What the code prints in a process of a checkout; None where it prints nothing."""
    path = os.pathsep.join((str(checkout), str(checkout / "benchmarks")))
    variables = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(kernels)}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=checkout, env=variables, stdout=subprocess.PIPE, text=True, check=True)
    found = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("seconds ")]
    return float(found[-1]) if found else None


def in_one_process(checkout: Path) -> float:
    """Core-seconds."""
    with tempfile.TemporaryDirectory() as folder:
        first, second = (seconds(checkout, STEP, Path(folder)) for _ in range(2))
    assert first is not None
    assert second is not None
    return first - second


def in_their_own(checkout: Path) -> float | None:
    """Core-seconds."""
    with tempfile.TemporaryDirectory() as folder:
        options = (f"hydra.run.dir={folder}/run", f"data.cache_dir={folder}/rooms", "data.eval_scenes=1")
        return seconds(checkout, TRAINING, Path(folder) / "kernels", *options)


def main() -> None:
    """Measures, prints and writes."""
    from before_after import commit
    from common import machine, parser, write_results

    from vg2gt.evaluation.tables import print_table

    options = parser(__doc__, passes=3)
    options.add_argument("--before", type=Path, required=True, help="a checkout")
    options.add_argument("--after", type=Path, default=HERE, help="another; this one by default")
    arguments = options.parse_args()
    sides = [path.resolve() for path in (arguments.before, arguments.after)]
    found = {side: {"one process": [], "processes of their own": []} for side in sides}
    for _ in range(arguments.passes):
        for side in sides:
            found[side]["one process"].append(in_one_process(side))
            found[side]["processes of their own"].append(in_their_own(side))
    rows = []
    for name in found[sides[0]]:
        taken = [[value for value in found[side][name] if value is not None] for side in sides]
        medians = [statistics.median(values) if values else None for values in taken]
        rows.append([name, *("-" if value is None else f"{value:.2f}" for value in medians)])
    print_table(("compiling, core-seconds", *map(commit, sides)), rows, title="medians")
    taken = {commit(side): found[side] for side in sides}
    write_results(arguments.out, "compilation-before-after", {"core_seconds": taken, "machine": machine()})


if __name__ == "__main__":
    main()
