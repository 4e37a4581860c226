"""Speed of the synthetic generator: ``python benchmarks/generator.py [--scenes N] [--size H W]``.

Frames a second of one core, by the time that the process computed, so that other processes hardly matter: scenes made
and rendered, and made, rendered and written to disk as ``python -m vg2gt.data.synthetic`` does. Compilation is left
out. Prints a table and writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

from machine import machine
from rich.console import Console
from rich.table import Table

from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes
from vg2gt.io.files import write_json

CASES = {
    "rooms": ("room", False),
    "rooms with highlights": ("room", True),
    "outdoor": ("outdoor", False),
    "outdoor with highlights": ("outdoor", True),
}


def render_all(settings: SceneSettings, scenes: int) -> int:
    """Makes and renders the scenes on one thread; returns the number of bytes written, none."""
    source = settings.source(scenes, 0)
    for name in source.scenes:
        source.scene(name).render(range(settings.frames), 1)
    return 0


def write_all(settings: SceneSettings, scenes: int) -> int:
    """Makes, renders and writes the scenes; returns the number of bytes written."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for _ in write_scenes(out, missing_scenes(out, scenes, 0, settings), settings):
            pass
        return sum(path.stat().st_size for path in out.rglob("*") if path.is_file())


def measure(work: Callable[[SceneSettings, int], int], settings: SceneSettings, scenes: int) -> dict[str, float]:
    """Frames a second of one core, and bytes a frame."""
    work(settings, 1)  # compiles
    started = time.process_time()
    written = work(settings, scenes)
    seconds = time.process_time() - started
    frames = scenes * settings.frames
    return {"frames_per_second": frames / seconds, "bytes_per_frame": written / frames}


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(224, 448))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    height, width = arguments.size
    table = Table(title=f"frames a second of one core, {height}x{width}")
    for heading in ("scenes", "rendered", "rendered and written", "kB a frame"):
        table.add_column(heading, justify="left" if heading == "scenes" else "right")
    results = {}
    for name, (variant, highlights) in CASES.items():
        settings = SceneSettings(arguments.frames, (height, width), variant, highlights)
        rendered = measure(render_all, settings, arguments.scenes)
        written = measure(write_all, settings, arguments.scenes)
        results[name] = {
            "rendered_frames_per_second": rendered["frames_per_second"],
            "written_frames_per_second": written["frames_per_second"],
            "bytes_per_frame": written["bytes_per_frame"],
        }
        speeds = (rendered["frames_per_second"], written["frames_per_second"])
        table.add_row(name, *(f"{speed:.2f}" for speed in speeds), f"{written['bytes_per_frame'] / 1e3:.0f}")
    Console().print(table)
    content = {
        "machine": machine(),
        "size": [height, width],
        "scenes": arguments.scenes,
        "frames": arguments.frames,
        "results": results,
    }
    print(write_json(arguments.out / f"{date.today().isoformat()}-generator.json", content))


if __name__ == "__main__":
    main()
