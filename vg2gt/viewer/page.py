"""A scene as one self-contained HTML file: Gaussians, cameras, pictures and the viewer's script.

The page loads nothing from the network. Its content security policy allows only the script with the given hash and no
connections, so that nothing in a scene can run code.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.files import write_text
from vg2gt.io.gaussian_arrays import to_arrays
from vg2gt.io.images import encode_image
from vg2gt.rendering.constants import ALPHA_MIN, COMPENSATION_FLOOR, JACOBIAN_CLAMP
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Gaussians
from vg2gt.viewer.content import ViewerScene

STATIC = Path(__file__).with_name("static")
_PARTS = "address shaders decode sorting detail camera picking controls renderer tools main"
SCRIPTS = tuple(f"{name}.js" for name in _PARTS.split())
JPEG_QUALITY = 85
UNSIGNED, SIGNED = 2**16 - 1, 2**15 - 1  # largest values stored in 16 bits


def write_viewer_html(path: str | Path, scene: ViewerScene) -> Path:
    """Writes the page atomically; it opens from disk in any browser with WebGL 2.

    Args:
        path: output file.
        scene: scene to show; not changed. Pictures are stored as JPEG, Gaussians as described in :func:`pack`.

    Raises:
        ValueError: if the Gaussians are of more than one scene or have values that cannot be shown.
    """
    header, packed = pack(scene.gaussians)
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
        "scene": _json_in_html(_content(scene, header)),
        "gaussians": base64.b64encode(packed).decode(),
        "script": script,
    }
    # one pass, so that no text inside a part is taken for a placeholder
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _static("page.html"))
    return write_text(path, page)


def pack(gaussians: Gaussians) -> tuple[dict[str, float], bytes]:
    """Encodes one scene for the page's script; the highest SH degrees are left out if they are all zero.

    Returns:
        Header for the script, and the columns, little endian and gzip-compressed: float32 means, float16 SH
        coefficients, 16-bit logarithms of the standard deviations between the scene's smallest and largest, 16-bit
        components of unit quaternions, 16-bit opacities.

    Raises:
        ValueError: if there is more than one scene, or a value that is not finite or out of range.
    """
    arrays = to_arrays(gaussians)
    length = np.linalg.norm(arrays.quats, axis=-1, keepdims=True)
    sh, half_max = arrays.sh, float(np.finfo(np.float16).max)
    while sh.shape[1] > 1 and not sh[:, (math.isqrt(sh.shape[1]) - 1) ** 2 :].any():
        sh = sh[:, : (math.isqrt(sh.shape[1]) - 1) ** 2]
    logs = np.log(arrays.scales)
    low, high = float(logs.min()), float(logs.max())
    columns = (
        arrays.means.astype("<f4"),
        sh.clip(-half_max, half_max).astype("<f2"),
        np.rint((logs - low) / max(high - low, 1e-12) * UNSIGNED).astype("<u2"),
        np.rint(arrays.quats / length * SIGNED).astype("<i2"),
        np.rint(arrays.opacities * UNSIGNED).astype("<u2"),
    )
    content = gzip.compress(b"".join(column.tobytes() for column in columns), compresslevel=6, mtime=0)
    degree = math.isqrt(sh.shape[1]) - 1
    return {"count": len(sh), "degree": degree, "log_scale_min": low, "log_scale_max": high}, content


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
    return base64.b64encode(encode_image(picture, "JPEG", quality=JPEG_QUALITY)).decode()


def _json_in_html(content: Any) -> str:
    """Returns JSON that cannot close the HTML element around it, whatever its strings contain."""
    text = json.dumps(content, allow_nan=False)  # everything beyond ASCII is escaped
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """Returns the content security policy's hash of an inline script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")
