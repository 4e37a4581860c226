"""Streams beside folders of PNG files: ``python benchmarks/streams.py RECORDING``; needs ``vg2gt[stream]``.

Writes the frames of an RGB-D recording as PNG files and as a stream at the same size, then reads random groups of
eight frames from each in turn, without a cache of decoded frames. Prints images per core-second and writes a dated JSON
file.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from common import machine, parser, write_results

from examples.write_recordings import write_recording
from vg2gt.data import RGBDFolder, SceneSource
from vg2gt.data.sources import Streamed
from vg2gt.data.sources.streamed import write_stream
from vg2gt.data.transforms import resize_to_cover

GROUP, ROUNDS = 8, 5


def write_folder(recording: str, folder: Path) -> RGBDFolder:
    """Writes a recording as ``images/ depth/ poses.txt K.txt``, all images PNG; returns it."""
    source = RGBDFolder(recording, holdout=None)
    scene = source.scenes[0]
    write_recording(folder / "scene", source.load(scene, source.frames(scene)))
    return RGBDFolder(str(folder / "scene"), holdout=None)


def rate(source: SceneSource, groups: Sequence[Sequence[int]]) -> float:
    """Returns images read per core-second."""
    start = time.process_time()
    for group in groups:
        source.load(source.scenes[0], group)
    return sum(map(len, groups)) / (time.process_time() - start)


def main() -> None:
    """Runs the comparison."""
    arguments = parser(__doc__)
    arguments.add_argument("recording")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as place:
        folder = write_folder(options.recording, Path(place) / "png")
        scene = folder.scenes[0]
        frames = list(folder.frames(scene))
        height, width = folder.load(scene, frames[:1]).depth.shape[-2:]
        out = str(Path(place) / "stream")
        write_stream(folder, folder.scenes, partial(resize_to_cover, size=(height, width)), f"{out}/train")
        sources: dict[str, SceneSource] = {"png": folder, "stream": Streamed(out)}
        sizes = {name: _megabytes(Path(place) / name) for name in sources}
        rng = np.random.default_rng(0)
        rates: dict[str, list[float]] = {name: [] for name in sources}
        for number in range(ROUNDS + 1):
            groups = [rng.choice(frames, GROUP, replace=False).tolist() for _ in range(4)]
            for name, source in sources.items():
                found = rate(source, groups)
                rates[name] += [found] if number else []
    print({name: f"{np.median(values):.0f} images per core-second" for name, values in rates.items()})
    ratio = float(np.median(rates["stream"]) / np.median(rates["png"]))
    content = {"machine": machine(), "size": [height, width], "frames": len(frames), "megabytes": sizes}
    write_results(options.out, "streams", content | {"images per core-second": rates, "ratio": ratio})


def _megabytes(folder: Path) -> float:
    return sum(os.path.getsize(path) for path in folder.rglob("*") if path.is_file()) / 1e6


if __name__ == "__main__":
    main()
