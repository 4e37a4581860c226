"""Report images of a reconstruction: input, colour, depth, normals and stated error of the views."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vg2gt.io.files import write_text
from vg2gt.io.images import colorize_depth, colorize_normals, encode_image, grid, to_pixels, write_png
from vg2gt.reconstruction.maps import AddView
from vg2gt.reconstruction.pictures import spread
from vg2gt.reconstruction.trust import trust_picture

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import RenderedView, Scene

PANELS = ("input", "rendered colour", "rendered depth", "rendered normals", "stated error")
LEGEND = " (0.3 % blue to 30 % red; purple: contradicted, grey: guessed, black: unseen)"
ROWS = 12
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1280px; padding: 0 1rem; color: #222 }
table { border-collapse: collapse } td, th { padding: 2px 12px 2px 0; text-align: left; vertical-align: top }
.view { display: grid; grid-template-columns: repeat(5, 1fr); gap: 4px; margin-bottom: 1rem }
.view img { width: 100% } h3 { margin: 0; font-size: 1rem; grid-column: 1 / -1 }
"""


def pictured(scene: Scene) -> list[int]:
    """Returns the views that ``report.png`` shows."""
    return list(spread(len(scene.names), min(len(scene.names), ROWS)))


@contextmanager
def png_report(scene: Scene, path: Path) -> Iterator[AddView]:
    """Writes one image with a row per view, for at most 12 evenly spread views."""
    depth_range, wanted = _depth_range(scene), {f"{scene.names[view]}.png": view for view in pictured(scene)}
    rows: list[list[Tensor]] = []

    def add(view: RenderedView) -> None:
        number = wanted.get(view.camera.name)
        if number is not None:
            rows.append(_panels(scene, number, view, depth_range))

    yield add
    write_png(path, grid(rows))


@contextmanager
def html_rows(scene: Scene, rows: list[str]) -> Iterator[AddView]:
    """Appends an HTML row per view with all its images, for :func:`write_html_report`."""
    depth_range = _depth_range(scene)

    def add(view: RenderedView) -> None:
        panels = _panels(scene, len(rows), view, depth_range)
        images = "".join(
            f'<img src="{_data("image/jpeg", encode_image(to_pixels(panel), "JPEG", quality=88))}" '
            f'alt="{name}" title="{name}">'
            for name, panel in zip(PANELS, panels, strict=False)
        )
        rows.append(f'<div class="view"><h3>{html.escape(scene.names[len(rows)])}</h3>{images}</div>')

    yield add


def write_html_report(
    path: Path, rows: Sequence[str], figures: Mapping[str, Any], orbit: Path | None, refined: Path | None = None
) -> None:
    """Writes a page with all its images embedded.

    Args:
        path: file to write.
        rows: one per view, from :func:`html_rows`.
        figures: entries of the table at the top.
        orbit: a GIF to show, or None.
        refined: a PNG of views before and after refinement, or None.
    """
    table = "".join(f"<tr><th>{html.escape(key)}</th><td>{_cell(value)}</td></tr>" for key, value in figures.items())
    moving = ""
    if orbit is not None:
        moving = f'<p><img src="{_data("image/gif", orbit.read_bytes())}" alt="orbit"></p>'
    if refined is not None:
        shown = _data("image/png", refined.read_bytes())
        moving += f'<h2>Refined: image | before | after | normals before | after</h2><p><img src="{shown}"></p>'
    title = f"Reconstruction of {len(rows)} views"
    write_text(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        f"<h1>{title}</h1><table>{table}</table>{moving}<p>{' | '.join(PANELS)}{LEGEND}</p>{''.join(rows)}</html>\n",
    )


def _panels(scene: Scene, number: int, view: RenderedView, depth_range: tuple[float, float]) -> list[Tensor]:
    depth, normals = colorize_depth(view.depth, *depth_range), colorize_normals(view.normal)
    panels = [scene.images[number], view.color, depth, normals]
    if scene.support is not None:
        panels.append(trust_picture(None if scene.error is None else scene.error[number], scene.support[number]))
    return panels


def _depth_range(scene: Scene) -> tuple[float, float]:
    """Returns the depth range of the colour map: the middle 96 % of the decoded depth."""
    visible = scene.depth[scene.depth > 0]
    visible = visible[:: max(1, len(visible) // 1_000_000)]
    low, high = torch.quantile(visible, torch.tensor([0.02, 0.98])).tolist()
    return low, high


def _cell(value: Any) -> str:
    if isinstance(value, Mapping):
        return "<br>".join(f"{html.escape(str(key))}: {html.escape(_text(item))}" for key, item in value.items())
    return html.escape(_text(value))


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
