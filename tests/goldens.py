"""Freezes what the project computes, to the last bit, and compares with it later: for changes that must change nothing.

``python -m tests.goldens freeze FOLDER`` writes ``FOLDER/golden.json`` and ``python -m tests.goldens check FOLDER``
names what differs; names of cases (:data:`CASES`) may follow. Equal bits can be expected on one machine, with one
thread and the same versions of the libraries.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

FIVE_STEPS = ("trainer.max_steps=5", "data.image_size=[56,112]", "data.train_scenes=3", "data.eval_scenes=1")
SHIPPED_ROOMS = ("data.eval_scenes=2", "data.image_size=[56,112]", "views=[4]", "evaluation.lpips=null", "device=cpu")

Values = dict[str, Any]


def _digest(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        value = repr((value.dtype, tuple(value.shape))).encode() + value.detach().cpu().contiguous().numpy().tobytes()
    return hashlib.sha256(value).hexdigest()[:16]


def _train(*overrides: str) -> Values:
    """A training run: its trained tensors, its metrics and its picture."""
    from vg2gt.config import compose
    from vg2gt.runs.checkpoints import newest, read_checkpoint
    from vg2gt.training.loop import train

    with tempfile.TemporaryDirectory() as folder:
        options = ("trainer.accelerator=cpu", "callbacks.progress_bar=null", "trainer.enable_progress_bar=false")
        train(compose("train", f"output_dir={folder}", *options, *overrides))
        state = read_checkpoint(newest(Path(folder, "checkpoints")))["state_dict"]
        report = json.loads(Path(folder, "metrics.json").read_text())
        picture = _digest(Path(folder, "preview.png").read_bytes())
    metrics = {f"{when} {name}": value for when in ("untrained", "trained") for name, value in report[when].items()}
    return {name: _digest(tensor) for name, tensor in state.items()} | metrics | {"preview": picture}


def _evaluate() -> Values:
    """The weights that ship with the package on unseen rooms; times and memory left out."""
    from vg2gt.config import compose
    from vg2gt.evaluation.run import evaluate

    with tempfile.TemporaryDirectory() as folder:
        report = evaluate(compose("evaluate", "ckpt=sweep-tiny", f"output_dir={folder}", "name=golden", *SHIPPED_ROOMS))
    means = {f"{views}/{name}": v for views, found in report["views"].items() for name, v in found["mean"].items()}
    return {name: value for name, value in means.items() if not name.endswith(("_seconds", "_mib"))}


def _reconstruct() -> Values:
    """A scene of a written recording by the weights that ship, rendered."""
    import vg2gt
    from tests.data.sources import layout_nerfstudio
    from tests.data.sources.layouts import room

    with tempfile.TemporaryDirectory() as folder:
        layout_nerfstudio.write(Path(folder), room())
        recording = next(Path(folder).rglob("transforms.json")).parent
        scene = vg2gt.load(device="cpu").reconstruct(recording, size=112)
    found: dict[str, torch.Tensor] = {}
    for index, view in enumerate(scene.render()):
        found |= {f"{name} {index}": getattr(view, name) for name in ("color", "depth", "normal", "alpha")}
    found |= {name: getattr(scene.gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    return {name: _digest(tensor) for name, tensor in found.items()}


def _layouts() -> Values:
    """Every layout of the tests, written and read back."""
    from tests.data.sources.layouts import all_layouts, room

    values: Values = {}
    for name, layout in all_layouts().items():
        with tempfile.TemporaryDirectory() as folder:
            layout.write(Path(folder), room())
            source = layout.read(Path(folder))
            for scene in source.scenes:
                frames = source.load(scene, source.frames(scene))
                for part in ("images", "depth", "world_to_camera", "intrinsics"):
                    values[f"{name} {scene} {part}"] = _digest(getattr(frames, part))
    return values


def _five(*overrides: str) -> Callable[[], Values]:
    return lambda: _train(*FIVE_STEPS, *overrides)


ABLATIONS = ("rasterized", "wo_depth", "wo_coarse", "wo_enhance", "wo_split")
CASES: Mapping[str, Callable[[], Values]] = {
    "layouts": _layouts,
    "reconstruct": _reconstruct,
    "evaluate": _evaluate,
    "five": _five(),
    **{name: _five(f"ablation={name}") for name in ABLATIONS},
    "pixel_aligned": _five("model=pixel_aligned"),
    "voxel_merged": _five("model=voxel_merged"),
    "sweep": _five("experiment=sweep", "token_cache.max_gb=0", "trainer.max_steps=5"),
    "vggt_tiny": _five("backend=vggt_tiny"),
    "da3_tiny": _five("backend=da3_tiny"),
    "quick": _train,
}


def main() -> None:
    """Freezes or checks."""
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.ERROR)
    action, folder, *names = sys.argv[1:]
    path = Path(folder, "golden.json")
    frozen: dict[str, Values] = json.loads(path.read_text()) if path.is_file() else {}
    differences = 0
    for name in names or CASES:
        found = CASES[name]()
        if action == "freeze":
            frozen[name] = found
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(frozen, indent=1))
            continue
        wrong = [f"{k}: {frozen[name].get(k)} -> {found.get(k)}" for k in frozen[name] | found
                 if str(frozen[name].get(k)) != str(found.get(k))]  # fmt: skip
        differences += len(wrong)
        print(f"{name}: {'equal' if not wrong else f'{len(wrong)} of {len(found)} differ'} ({len(found)} values)")
        print("".join(f"    {line}\n" for line in wrong[:8]), end="", flush=True)
    sys.exit(bool(differences))


if __name__ == "__main__":
    main()
