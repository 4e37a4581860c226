"""VG²GT compared with baselines: ``python benchmarks/baselines.py [steps=N] [seeds=N] [overrides of train.yaml]``.

All models are trained from scratch for the same number of steps, with the same backbone, losses, batches and machine,
and evaluated on the same held-out scenes: VG²GT, VG²GT with finer voxels (about 40 % of the pixel-aligned Gaussians),
VG²GT without its coarse module (which separates the effect of voxels from that of enhanced geometry), one Gaussian per
pixel, pixel Gaussians merged by voxels, and coloured points, which need no training. Finished trainings are not
repeated; interrupted ones resume.

``coarse=PATH`` initialises the coarse modules, and nothing else, from a checkpoint, with
``training.coarse_lr_factor=0.3``. ``models=NAME,NAME`` selects models by the names of their folders; ``da3_gs`` (DA3's
own Gaussians, needs ``backend=da3_giant``) only runs if named. Writes runs, ``metrics.json`` and ``metrics.md`` to
``outputs/<name>``; default: name=baselines.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from common import machine

from vg2gt.evaluation.tables import columns
from vg2gt.io.files import write_json, write_text
from vg2gt.runs.checkpoints import read_checkpoint
from vg2gt.studies.study import Metrics, quoted, run_once, seeds_table, summarize, write_part

DEFAULTS = {"name": "baselines", "steps": "400", "seeds": "1", "coarse": "", "models": ""}
COARSE = "model.coarse."
REFERENCE = "VG²GT"
ASKED = "da3_gs"  # runs only if named
COLUMNS = columns(
    *("psnr", "ssim", "rmse", "abs_rel", "delta_1.05", "abs_rel_rasterized", "decoded_abs_rel", "normal_mean"),
    *("edge_abs_rel", "edge_psnr", "coverage", "cv", "gaussians"),
)


@dataclass(frozen=True)
class Model:
    """A row of the table: folder of its runs, Hydra overrides, and whether it is trained."""

    folder: str
    overrides: tuple[str, ...] = ()
    trained: bool = True


MODELS = {
    REFERENCE: Model("vg2gt"),
    "VG²GT, 2 px": Model("vg2gt_fine", ("model.fine.min_footprint=2.02",)),
    "VG²GT w/o coarse": Model("wo_coarse", ("ablation=wo_coarse",)),
    "pixel-aligned": Model("pixel_aligned", ("model=pixel_aligned",)),
    "voxel-merged": Model("voxel_merged", ("model=voxel_merged",)),
    "coloured points": Model("pointcloud", ("model=pointcloud",), trained=False),
    "DA3": Model(ASKED, ("model=da3_gs",), trained=False),
}


def chosen(names: str) -> dict[str, Model]:
    """Returns the models named by ``models=``, or all that run with any backend; raises SystemExit if unknown."""
    folders = [model.folder for model in MODELS.values()]
    if unknown := set(names.split(",")) - {*folders, ""}:
        raise SystemExit(f"models={names}: unknown {', '.join(sorted(unknown))}; choose from {', '.join(folders)}")
    named = set(names.split(",")) if names else {*folders} - {ASKED}
    return {name: model for name, model in MODELS.items() if model.folder in named}


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


def report(results: Mapping[str, Mapping[int, Metrics]], options: Mapping[str, str]) -> str:
    """Returns the table as Markdown."""
    trained_first = " after a coarse module trained first and alone" if options["coarse"] else ""
    protocol = (
        f"{options['steps']} training steps each, {options['seeds']} seed(s){trained_first} (mean ± 95 % confidence "
        "interval where there are several). Scenes never trained on, held-out views at ground-truth poses, rendered as "
        "stochastic solids, depth aligned by one median scale per scene."
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
    results: dict[str, dict[int, Metrics]] = {name: {} for name in models}  # by model and seed
    for seed in range(int(options["seeds"])):
        for name, model in models.items():
            folder = home / f"seed-{seed}" / model.folder
            steps = options["steps"] if model.trained else "0"
            start = begin if model.folder.startswith("vg2gt") else ()  # has a coarse module
            mine = [*overrides, f"seed={seed}", f"trainer.max_steps={steps}", *start]
            print(f"seed {seed}: {name}", flush=True)
            results[name][seed] = run_once([*mine, *model.overrides], folder)
            content = {"options": options, "overrides": overrides, "machine": machine(), "runs": results}
            write_json(home / "metrics.json", content | {"summary": summarize(results, REFERENCE)})
            write_text(home / "metrics.md", report(results, options))
    print(report(results, options))
    print(f"metrics: {home / 'metrics.json'}")


if __name__ == "__main__":
    main()
