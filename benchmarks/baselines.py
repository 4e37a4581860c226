"""VG²GT compared with baselines: ``python benchmarks/baselines.py [steps=N] [seeds=N] [overrides of train.yaml]``.

All models are trained from scratch for the same number of steps, with the same backbone, losses, batches and machine,
and evaluated on the same held-out scenes: VG²GT, VG²GT with finer voxels (about 40 % of the pixel-aligned Gaussians),
VG²GT without its coarse module (which separates the effect of voxels from that of enhanced geometry), one Gaussian per
pixel, pixel Gaussians merged by voxels, and coloured points, which need no training. Finished trainings are not
repeated; interrupted ones resume.

``coarse=PATH`` initialises the coarse modules, and nothing else, from a checkpoint, with
``training.coarse_lr_factor=0.3``. ``models=NAME,NAME`` selects models by the names of their folders; ``da3_gs`` (DA3's
own Gaussians, needs ``backend=da3_giant``) only runs if named. Writes runs, ``metrics.json``, ``metrics.md`` and
``models.png`` to ``outputs/<name>``; default: name=baselines.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from common import machine

from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.evaluation.tables import Metric, columns
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.io.files import write_json, write_text
from vg2gt.io.images import colorize_depth, colorize_normals, grid, write_png
from vg2gt.profiling import clocked, now
from vg2gt.runs.checkpoints import read_checkpoint
from vg2gt.studies.study import (
    Metrics,
    compose_run,
    final_checkpoint,
    quoted,
    run_once,
    seeds_table,
    summarize,
    write_part,
)
from vg2gt.training.loop import Run, build
from vg2gt.types import Batch

DEFAULTS = {"name": "baselines", "steps": "400", "seeds": "1", "coarse": "", "models": ""}
COARSE = "model.coarse."
REFERENCE = "VG²GT"
MAX_ERROR = 0.1  # relative depth error that is shown as white
COLUMNS = columns(
    *("psnr", "ssim", "rmse", "abs_rel", "delta_1.05", "abs_rel_rasterized", "decoded_abs_rel", "normal_mean"),
    *("edge_abs_rel", "edge_psnr", "coverage", "cv", "gaussians"),
) | {
    "head_seconds": Metric("head, s", 2, False),
    "reconstruction_seconds": Metric("all, s", 2, False),
    "render_seconds": Metric("render a view, s", 3, False),
}


@dataclass(frozen=True)
class Model:
    """A row of the table.

    Attributes:
        folder: folder of its runs.
        overrides: Hydra overrides.
        trained: whether it is trained.
        coarse: whether it has a coarse module.
        asked: whether it runs only if named.
    """

    folder: str
    overrides: tuple[str, ...] = ()
    trained: bool = True
    coarse: bool = False
    asked: bool = False


MODELS = {
    REFERENCE: Model("vg2gt", coarse=True),
    "VG²GT, 2 px": Model("vg2gt_fine", ("model.fine.min_footprint=2.02",), coarse=True),
    "VG²GT w/o coarse": Model("wo_coarse", ("ablation=wo_coarse",)),
    "pixel-aligned": Model("pixel_aligned", ("model=pixel_aligned",)),
    "voxel-merged": Model("voxel_merged", ("model=voxel_merged",)),
    "coloured points": Model("pointcloud", ("model=pointcloud",), trained=False),
    "DA3": Model("da3_gs", ("model=da3_gs",), trained=False, asked=True),
}


def restore(model: Model, overrides: list[str], steps: int, folder: Path) -> tuple[Run, Batch]:
    """Returns the run with its trained module in eval mode, and the first evaluation scene."""
    run = build(compose_run([*overrides, *model.overrides], folder))
    if model.trained:
        run.module.load_state_dict(read_checkpoint(final_checkpoint(folder, steps))["state_dict"])
    run.datamodule.setup("validate")
    run.module.eval()
    return run, next(iter(run.datamodule.val_dataloader())).single(0).to(run.module.device)


@torch.no_grad()
def costs(run: Run, batch: Batch, passes: int = 3) -> Metrics:
    """Measures the best seconds of a reconstruction, of its head, and of rendering one view."""
    device, context, found = run.module.device, batch.context, []
    for _ in range(passes):
        with clocked(device) as clock:
            prediction = run.module.model(context.images, context.hints)
        begin = now(device)
        run.module.renderer(prediction.gaussians, prediction.geometry.cameras.select(slice(0, 1)))
        found.append((clock.head, clock.total, now(device) - begin))
    return dict(zip(("head_seconds", "reconstruction_seconds", "render_seconds"), map(min, *found), strict=True))


@torch.no_grad()
def panels(run: Run, batch: Batch) -> list[torch.Tensor]:
    """Renders a held-out view: colour, depth, relative depth error (black 0, white 10 % or no depth), and normals."""
    prediction = run.module.model(batch.context.images, batch.context.hints)
    cameras = ground_truth_target_cameras(batch, prediction).select(slice(0, 1))
    rendered, true = run.module.renderer(prediction.gaussians, cameras, mode="solid"), batch.target.depth[0, 0]
    depth = rendered.depth[0, 0]
    both = (depth > 0) & (true > 0)
    depth = depth * (true[both] / depth[both]).median()
    error = ((depth / true.clamp_min(1e-6) - 1).abs() / MAX_ERROR).clamp(0, 1)
    error = torch.where(depth > 0, error, 1.0) * (true > 0)
    near, far = (float(true[true > 0].quantile(q)) for q in (0.02, 0.98))
    normals = colorize_normals(rendered.normal[0, 0])
    return [rendered.color[0, 0], colorize_depth(depth, near, far), error.expand(3, -1, -1), normals]


def truth(batch: Batch) -> list[torch.Tensor]:
    """Returns the ground truth of the held-out view, in the columns of :func:`panels`."""
    true = batch.target.depth[0, 0]
    near, far = (float(true[true > 0].quantile(q)) for q in (0.02, 0.98))
    normals, _ = normals_from_depth(true, batch.target.cameras.intrinsics[0, 0])
    image = batch.target.images[0, 0]
    return [image, colorize_depth(true, near, far), torch.zeros_like(image), colorize_normals(normals)]


def chosen(names: str) -> dict[str, Model]:
    """Returns the models named by ``models=``, or all that run with any backend; raises SystemExit if unknown."""
    folders = [model.folder for model in MODELS.values()]
    if unknown := set(names.split(",")) - {*folders, ""}:
        raise SystemExit(f"models={names}: unknown {', '.join(sorted(unknown))}; choose from {', '.join(folders)}")
    return {
        name: model
        for name, model in MODELS.items()
        if (model.folder in names.split(",") if names else not model.asked)
    }


def coarse_start(path: str, home: Path) -> tuple[str, ...]:
    """Returns overrides that initialise the coarse module from a checkpoint; other weights depend on the seed.

    Raises:
        SystemExit: if the checkpoint has no coarse module.
    """
    if not path:
        return ()
    home.mkdir(parents=True, exist_ok=True)
    if not any(name.startswith(COARSE) for name in read_checkpoint(path)["state_dict"]):
        raise SystemExit(f"coarse={path}: this checkpoint has no coarse module; use one of experiment=sweep_coarse")
    start = write_part(Path(path), home / "coarse.ckpt", lambda name: name.startswith(COARSE))
    return f"init_from={quoted(start)}", "training.coarse_lr_factor=0.3"


Results = dict[str, dict[int, Metrics]]  # by model and seed


def report(results: Results, options: Mapping[str, str]) -> str:
    """Returns the table as Markdown."""
    trained_first = " after a coarse module trained first and alone" if options["coarse"] else ""
    protocol = (
        f"{options['steps']} training steps each, {options['seeds']} seed(s){trained_first} (mean ± 95 % confidence "
        "interval where there are several). Scenes never trained on, held-out views at ground-truth poses, rendered as "
        "stochastic solids, depth aligned by one median scale per scene. Times: best of three passes on one scene."
    )
    table = seeds_table({name: runs for name, runs in results.items() if runs}, COLUMNS)
    return "\n\n".join(("# VG²GT and baselines", protocol, table)) + "\n"


def main() -> None:
    """Trains models that are not trained yet, measures and writes."""
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        return
    given = [argument.partition("=")[::2] for argument in sys.argv[1:]]
    options = DEFAULTS | {key: value for key, value in given if key in DEFAULTS}
    overrides = [argument for argument in sys.argv[1:] if argument.partition("=")[0] not in DEFAULTS]
    home = Path("outputs").resolve() / options["name"]
    models, begin = chosen(options["models"]), coarse_start(options["coarse"], home)
    results: Results = {name: {} for name in models}
    rows: list[list[torch.Tensor]] = []
    for seed in range(int(options["seeds"])):
        for name, model in models.items():
            folder = home / f"seed-{seed}" / model.folder
            steps = options["steps"] if model.trained else "0"
            mine = [*overrides, f"seed={seed}", f"trainer.max_steps={steps}", *(begin if model.coarse else ())]
            print(f"seed {seed}: {name}", flush=True)
            metrics = run_once([*mine, *model.overrides], folder)
            run, batch = restore(model, mine, int(steps), folder)
            results[name][seed] = metrics | costs(run, batch)
            if seed == 0:
                rows = rows or [truth(batch)]
                rows.append(panels(run, batch))
                write_png(home / "models.png", grid(rows))
            content = {
                "options": options,
                "overrides": overrides,
                "machine": machine(run.module.device),
                "runs": results,
                "summary": summarize(results, REFERENCE),
            }
            write_json(home / "metrics.json", content)
            write_text(home / "metrics.md", report(results, options))
    print(report(results, options))
    print(f"rows of models.png: truth, {', '.join(models)}; colour, depth, relative depth error, normals")
    print(f"metrics: {home / 'metrics.json'}")


if __name__ == "__main__":
    main()
