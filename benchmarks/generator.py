"""Speed of the synthetic generator: ``python benchmarks/generator.py [--scenes N] [--size H W]``.

Frames per second of one core, by the time that the process computed, so that other processes hardly matter: scenes
made and rendered, and made, rendered and written to disk as ``vg2gt data synthetic`` does. Compilation is left
out. Prints a table and writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from common import machine, parser, write_results

from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes
from vg2gt.evaluation.tables import print_table

CASES = {
    "rooms": ("room", False),
    "rooms with highlights": ("room", True),
    "outdoor": ("outdoor", False),
    "outdoor with highlights": ("outdoor", True),
    "wide rooms": ("wide", False),
    "objects": ("object", False),
    "landmarks": ("landmark", False),
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
    """Frames per second of one core, and bytes per frame."""
    work(settings, 1)  # compiles
    started = time.process_time()
    written = work(settings, scenes)
    seconds = time.process_time() - started
    frames = scenes * settings.frames
    return {"frames_per_second": frames / seconds, "bytes_per_frame": written / frames}


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--scenes", type=int, default=12)
    options.add_argument("--frames", type=int, default=8)
    options.add_argument("--size", type=int, nargs=2, default=(224, 448))
    arguments = options.parse_args()
    height, width = arguments.size
    results, rows = {}, []
    for name, (variant, highlights) in CASES.items():
        settings = SceneSettings(arguments.frames, (height, width), variant, highlights)
        rendered = measure(render_all, settings, arguments.scenes)["frames_per_second"]
        written = measure(write_all, settings, arguments.scenes)
        results[name] = {
            "rendered_frames_per_second": rendered,
            "written_frames_per_second": written["frames_per_second"],
            "bytes_per_frame": written["bytes_per_frame"],
        }
        speeds = [f"{rendered:.2f}", f"{written['frames_per_second']:.2f}"]
        rows.append([name, *speeds, f"{written['bytes_per_frame'] / 1e3:.0f}"])
    head = ("scenes", "rendered", "rendered and written", "kB per frame")
    print_table(head, rows, title=f"frames per second of one core, {height}x{width}")
    content = {
        "machine": machine(),
        "size": [height, width],
        "scenes": arguments.scenes,
        "frames": arguments.frames,
        "results": results,
    }
    write_results(arguments.out, "generator", content)


if __name__ == "__main__":
    main()
