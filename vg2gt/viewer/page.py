"""A scene as one HTML file: Gaussians, cameras, pictures and the viewer's own script, nothing fetched from anywhere.

The page's security policy names its script by hash and allows no connection, so that neither a name in a scene nor
anything else in the file can run code or reach a network.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path
from typing import Any

from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_text
from vg2gt.io.images import encode_image
from vg2gt.kernels.constants import ALPHA_MIN, JACOBIAN_CLAMP
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Gaussians
from vg2gt.viewer.content import ViewerScene
from vg2gt.viewer.packing import PackedGaussians, pack, unpack

STATIC = Path(__file__).with_name("static")
SCRIPTS = ("shaders.js", "decode.js", "sorting.js", "camera.js", "controls.js", "renderer.js", "main.js")
_JPEG_QUALITY = 85


def write_viewer_html(path: str | Path, scene: ViewerScene) -> Path:
    """Writes the page, atomically; it opens from the disk in any browser with WebGL 2.

    Args:
        path: the file.
        scene: what to show; not changed. Pictures are stored as JPEG, Gaussians as :mod:`vg2gt.viewer.packing` says.

    Raises:
        ValueError: if the Gaussians are of more than one scene or have values that cannot be shown.
    """
    packed = pack(scene.gaussians)
    script = '(() => {\n"use strict";\n' + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; worker-src blob:; style-src '{_hash(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy,
        "title": html.escape(scene.title),
        "style": style,
        "scene": _json_in_html(_content(scene, packed)),
        "gaussians": base64.b64encode(packed.content).decode(),
        "script": script,
    }
    # one pass, so that nothing inside a part is taken for a place
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _static("page.html"))
    return write_text(path, page)


def read_viewer_html(path: str | Path) -> Gaussians:
    """The Gaussians inside a page, as it shows them.

    Raises:
        FormatError: if the file is no such page or damaged.
    """
    path = Path(path)
    try:
        page = path.read_text()
        content, data = (re.search(rf'id="{name}">([^<]*)<', page) for name in ("scene", "gaussians"))
        if content is None or data is None:
            raise ValueError("it holds no scene")
        header = json.loads(content[1])["gaussians"]
        return unpack(PackedGaussians(**header, content=base64.b64decode(data[1], validate=True)))
    except (ValueError, KeyError, TypeError, EOFError, OverflowError) as error:
        raise FormatError(f"{path} is not a whole page of `vg2gt view --html`: {error}; write it again") from error


def _content(scene: ViewerScene, packed: PackedGaussians) -> dict[str, Any]:
    """What the script finds in the page besides the Gaussians."""
    options = RenderOptions(mode="rasterized")
    cameras = [{**camera.fields(), "picture": _jpeg(scene, index)} for index, camera in enumerate(scene.cameras)]
    behind = scene.gaussians.background
    return {
        "gaussians": packed.header(),
        "cameras": cameras,
        "initial": scene.initial().fields(),
        "frustum_depth": scene.frustum_depth(),
        "settings": {
            "near": options.near,
            "background": [0.0, 0.0, 0.0] if behind is None else behind[0].tolist(),
            "lowpass": options.lowpass,
            "alpha_max": options.alpha_max,
            "alpha_min": ALPHA_MIN,
            "jacobian_clamp": JACOBIAN_CLAMP,
        },
    }


def _jpeg(scene: ViewerScene, index: int) -> str | None:
    picture = scene.picture(index)
    if picture is None:
        return None
    return base64.b64encode(encode_image(picture, "JPEG", quality=_JPEG_QUALITY)).decode()


def _json_in_html(content: Any) -> str:
    """JSON that cannot end the element it is in, whatever its strings hold."""
    text = json.dumps(content, allow_nan=False)  # everything beyond ASCII is escaped
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """A security policy's name of an inline script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")
