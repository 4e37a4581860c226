"""A scene as one self-contained HTML file: Gaussians, cameras, pictures and the viewer's script.

The page loads nothing from the network. Its content security policy allows only the script with the given hash and no
connections, so that nothing in a scene can run code. That of a page with tiles allows what this script loads, too.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.files import write_text
from vg2gt.io.images import encode_image
from vg2gt.rendering.constants import ALPHA_MIN, COMPENSATION_FLOOR, JACOBIAN_CLAMP
from vg2gt.rendering.options import RenderOptions
from vg2gt.viewer.content import ViewerScene
from vg2gt.viewer.levels import TILE, write_levels
from vg2gt.viewer.packing import pack, without_zeros

STATIC = Path(__file__).with_name("static")
_PARTS = "address shaders decode sorting detail camera levels picking controls renderer tools main"
SCRIPTS = tuple(f"{name}.js" for name in _PARTS.split())
_JPEG_QUALITY = 85


def write_viewer_html(path: str | Path, scene: ViewerScene, levels: bool = False) -> Path:
    """Writes the page atomically; it opens from disk in any browser with WebGL 2.

    Args:
        path: output file.
        scene: scene to show; not changed. Pictures are stored as JPEG, Gaussians as described in :func:`pack`.
        levels: write levels of detail in tiles to a folder next to the page, its name with ``_levels``, from which the
            page loads what the view needs; scenes that fit into one tile need none.

    Raises:
        ValueError: if the Gaussians are of more than one scene or have values that cannot be shown, or the folder has
            other files.
    """
    path, gaussians, tiles = Path(path), without_zeros(scene.gaussians), None
    if levels and len(gaussians) > TILE:
        gaussians, tiles = write_levels(path.with_name(f"{path.stem}_levels"), gaussians)
    header, packed = pack(gaussians)
    script = '(() => {\n"use strict";\n' + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    loaded = " 'strict-dynamic'" if tiles else ""
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'{loaded}; worker-src blob:; style-src '{_hash(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy,
        "title": html.escape(scene.title),
        "style": style,
        "scene": _json_in_html({**_content(scene, header), "levels": tiles}),
        "gaussians": base64.b64encode(packed).decode(),
        "script": script,
    }
    # one pass, so that no text inside a part is taken for a placeholder
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _static("page.html"))
    return write_text(path, page)


def _content(scene: ViewerScene, header: dict[str, float]) -> dict[str, Any]:
    """Returns the page's JSON content, without the packed Gaussians."""
    options = RenderOptions(mode="rasterized")
    pictures = scene.pictures or [None] * len(scene.cameras)
    cameras = [
        {**camera.fields(), "picture": None if picture is None else _jpeg(picture)}
        for camera, picture in zip(scene.cameras, pictures, strict=True)
    ]
    behind = scene.gaussians.background
    return {
        "gaussians": header,
        "cameras": cameras,
        "initial": scene.initial().fields(),
        "frustum_depth": scene.frustum_depth(),
        "settings": {
            "near": scene.near,
            "background": [0.0, 0.0, 0.0] if behind is None else behind[0].tolist(),
            "lowpass": options.lowpass,
            "antialiased": scene.antialiased,
            "compensation_floor": COMPENSATION_FLOOR,
            "alpha_max": options.alpha_max,
            "alpha_min": ALPHA_MIN,
            "jacobian_clamp": JACOBIAN_CLAMP,
        },
    }


def _jpeg(picture: NDArray[np.uint8]) -> str:
    return base64.b64encode(encode_image(picture, "JPEG", quality=_JPEG_QUALITY)).decode()


def _json_in_html(content: Any) -> str:
    """Returns JSON that cannot close the HTML element around it, whatever its strings contain."""
    text = json.dumps(content, allow_nan=False)  # everything beyond ASCII is escaped
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """Returns the content security policy's hash of an inline script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")
