"""What a person waits for beside training, before and after: ``python benchmarks/waits.py --before FOLDER``.

Two checkouts in turns, every measurement in a process of its own on one thread, in core-seconds: help texts, imports,
and the renderer forward and backward (as ``render.py`` does it). The token cache is measured on the later checkout
alone: a step of ``da3_small`` with random weights, 8 views of 112x224, when its sets of views come for the first time
and again. Kernels are compiled before. ``before_after.py`` measures a step, ``compilation.py`` the kernels.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
COUNTS = (100_000, 300_000)
HELP = "import sys; sys.argv = {argv}; from vg2gt.cli import main; main()"
STARTS = {
    "train.py -h": "import sys; sys.argv = ['train.py', '-h']; from vg2gt.cli.train import main; main()",
    "vg2gt reconstruct --help": HELP.format(argv=["vg2gt", "reconstruct", "--help"]),
    "vg2gt evaluate --help": HELP.format(argv=["vg2gt", "evaluate", "--help"]),
    "import vg2gt": "import vg2gt",
    "import vg2gt.reconstruction": "import vg2gt.reconstruction",
}
RENDER = """
import sys, torch
from render import Case, compare
cases = [Case("cpu", int(count), geometry=geometry) for count in sys.argv[1:] for geometry in (True, False)]
for case, timing in zip(cases, compare(cases, torch.device("cpu"), 4)):
    name = f"{case.gaussians:,} Gaussians, " + ("everything" if case.geometry else "colour")
    print("took", (timing.forward + timing.backward) / 1e3, name)
"""
TOKENS = """
import sys, tempfile, time
from pathlib import Path
import torch
from common import training_step
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import build
torch.set_num_threads(1)
SETS, EPOCHS = 4, 4
with tempfile.TemporaryDirectory() as folder:
    overrides = [
        "backend=da3_small", "backend.pretrained=false", "data.image_size=[112,224]", f"data.train_scenes={SETS}",
        "data.min_views=8", "data.max_views=8", "data.max_images=8", "data.view_sets=1",
        "token_cache.max_gb=1", f"token_cache.folder={folder}/tokens",
    ]
    run = build(compose_run(overrides, Path(folder)))
    run.datamodule.setup("fit")
    step, seconds, losses = training_step(run), {}, {}
    batches = iter(run.datamodule.train_dataloader())
    for _ in range(SETS * EPOCHS):
        batch = next(batches)
        run.module.generator.manual_seed(0)
        key = batch.scene, tuple(batch.frame_ids.flatten().tolist())
        start = time.process_time()
        loss = step(batch)
        loss.backward()
        seconds.setdefault(key, []).append(time.process_time() - start)
        losses.setdefault(key, set()).add(float(loss.detach()))
    assert all(len(values) == 1 for values in losses.values()), losses
    timings = list(seconds.values())[1:]
    print("took", sum(values[0] for values in timings) / len(timings), "a set of views for the first time")
    again = [value for values in timings for value in values[1:]]
    print("took", sum(again) / len(again), "again")
"""


def took(checkout: Path, code: str, *arguments: str) -> dict[str, float]:
    """What the code prints in a process of a checkout, by name; where it prints nothing, what the process took."""
    path = os.pathsep.join((str(checkout), str(checkout / "benchmarks")))
    variables = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code, *arguments]
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, cwd=checkout, env=variables, stdout=said)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"exit status {process.returncode}; what was said stands above")
        said.seek(0)
        lines = [line.split(maxsplit=2) for line in said if line.startswith("took ")]
    found = {name.strip(): float(value) for _, value, name in lines}
    return found or {"all": usage.ru_utime + usage.ru_stime}


def main() -> None:
    """Measures, prints and writes."""
    from before_after import commit
    from common import machine, parser, write_results

    from vg2gt.evaluation.tables import print_table

    options = parser(__doc__, passes=3)
    options.add_argument("--before", type=Path, required=True, help="a checkout")
    options.add_argument("--after", type=Path, default=HERE, help="another; this one by default")
    options.add_argument("--gaussians", nargs="*", default=[str(count) for count in COUNTS])
    arguments = options.parse_args()
    sides = [path.resolve() for path in (arguments.before, arguments.after)]
    found: dict[str, list[list[float]]] = {}
    for number in range(arguments.passes + 1):  # the first warms up: files are read, kernels compiled
        for index, side in enumerate(sides):
            once = {name: took(side, code)["all"] for name, code in STARTS.items()}
            once |= took(side, RENDER, *arguments.gaussians)
            for name, value in once.items():
                found.setdefault(name, [[], []])[index] += [value] if number else []
    medians = {name: [statistics.median(values) for values in both] for name, both in found.items()}
    rows = [[name, f"{old:.3f}", f"{new:.3f}", f"{new / old:.2f}"] for name, (old, new) in medians.items()]
    print_table(("core-seconds, medians", *map(commit, sides), "ratio"), rows)
    tokens = took(sides[1], TOKENS)
    first, again = tokens.values()
    print_table(("a step's core-seconds", "token cache"), [[name, f"{value:.3f}"] for name, value in tokens.items()])
    print(f"ratio {again / first:.2f}; losses bit-equal")
    content = {"before": commit(sides[0]), "after": commit(sides[1]), "core_seconds": found, "token_cache": tokens}
    write_results(arguments.out, "waits-before-after", {**content, "machine": machine()})


if __name__ == "__main__":
    main()
