"""nerfstudio captures: one camera or one per frame, with and without depth."""

from functools import partial
from pathlib import Path

from vg2gt.data import Frames
from vg2gt.data.sources import Nerfstudio
from vg2gt.io import Lens, Transforms, TransformsFrame, write_transforms

from .layouts import SIZE, Layout, millimetres, pixels, save


def write(root: Path, frames: Frames, depth: bool = True) -> None:
    """``transforms.json``, ``images/`` and ``depth/`` in millimetres."""
    records = []
    for i, image in enumerate(pixels(frames)):
        save(root / "desk" / "images" / f"{i:04d}.png", image)
        save(root / "desk" / "depth" / f"{i:04d}.png", millimetres(frames)[i])
        lens = Lens.from_intrinsics(frames.intrinsics[i].double().numpy(), SIZE)
        pose = frames.world_to_camera[i].double().numpy()
        # Some writers leave the suffix out.
        name = f"images/{i:04d}" + ("" if i % 2 else ".png")
        records.append(TransformsFrame(name, pose, lens, f"depth/{i:04d}.png" if depth else None))
    write_transforms(root / "desk" / "transforms.json", Transforms(tuple(records[::-1])))


LAYOUTS = {
    "nerfstudio": Layout(partial(write, depth=False), Nerfstudio, depth_quantum=None),
    "nerfstudio_depth": Layout(write, partial(Nerfstudio, depth=True)),
}
