"""Pictures of a reconstruction: input, colour, depth and normals of the views."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from vg2gt.io.files import write_text
from vg2gt.io.images import colorize_depth, colorize_normals, grid, write_png
from vg2gt.reconstruction.maps import to_pixels
from vg2gt.reconstruction.scene import RenderedView, Scene

PANELS = ("input", "rendered colour", "rendered depth", "rendered normals")
ROWS = 12
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1280px; padding: 0 1rem; color: #222 }
table { border-collapse: collapse } td, th { padding: 2px 12px 2px 0; text-align: left; vertical-align: top }
.view { display: grid; grid-template-columns: repeat(4, 1fr); gap: 4px; margin-bottom: 1rem }
.view img { width: 100% } h3 { margin: 0; font-size: 1rem; grid-column: 1 / -1 }
"""


class PngReport:
    """One picture with a row a view, of at most 12 views, evenly spread."""

    def __init__(self, scene: Scene, path: Path) -> None:
        self.scene = scene
        self.path = path
        self._range = _depth_range(scene)
        count = len(scene.names)
        self._wanted = {round(i * (count - 1) / max(min(count, ROWS) - 1, 1)) for i in range(min(count, ROWS))}
        self._rows: list[list[Tensor]] = []
        self._next = 0

    def add(self, view: RenderedView) -> None:
        """Draws the next view, if it is among those shown."""
        if self._next in self._wanted:
            self._rows.append(_panels(self.scene.images[self._next], view, self._range))
        self._next += 1

    def close(self) -> None:
        """Writes the picture."""
        write_png(self.path, grid(self._rows))


class HtmlReport:
    """A page that holds all its pictures: figures of the run and a row a view."""

    def __init__(self, scene: Scene, path: Path) -> None:
        self.scene = scene
        self.path = path
        self._range = _depth_range(scene)
        self._rows: list[str] = []

    def add(self, view: RenderedView) -> None:
        """Draws the next view."""
        number = len(self._rows)
        panels = _panels(self.scene.images[number], view, self._range)
        images = "".join(
            f'<img src="{_jpeg(panel)}" alt="{name}" title="{name}">'
            for name, panel in zip(PANELS, panels, strict=True)
        )
        self._rows.append(f'<div class="view"><h3>{html.escape(self.scene.names[number])}</h3>{images}</div>')

    def close(self) -> None:
        """Nothing yet: the figures are known at the very end."""

    def write(self, figures: Mapping[str, Any], orbit: Path | None) -> None:
        """Writes the page.

        Args:
            figures: the table at the top.
            orbit: a GIF to show, or None.
        """
        rows = "".join(f"<tr><th>{html.escape(key)}</th><td>{_cell(value)}</td></tr>" for key, value in figures.items())
        moving = ""
        if orbit is not None:
            moving = f'<p><img src="{_data("image/gif", orbit.read_bytes())}" alt="orbit"></p>'
        title = f"Reconstruction of {len(self.scene.names)} views"
        write_text(
            self.path,
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
            f"<h1>{title}</h1><table>{rows}</table>{moving}<p>{' | '.join(PANELS)}</p>{''.join(self._rows)}</html>\n",
        )


def _panels(image: Tensor, view: RenderedView, depth_range: tuple[float, float]) -> list[Tensor]:
    return [image, view.color, colorize_depth(view.depth, *depth_range), colorize_normals(view.normal)]


def _depth_range(scene: Scene) -> tuple[float, float]:
    """Depths that colours span: the middle 96 % of the decoded depth."""
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


def _jpeg(panel: Tensor) -> str:
    buffer = io.BytesIO()
    Image.fromarray(to_pixels(panel)).save(buffer, "JPEG", quality=88)
    return _data("image/jpeg", buffer.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
