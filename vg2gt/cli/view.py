"""``vg2gt view SCENE``: shows a scene in the browser, live or as one self-contained page (docs/guides/view.md)."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vg2gt.cli.arguments import flag_parser
from vg2gt.cli.errors import errors_in_one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vg2gt.io.cameras_json import NamedCamera
    from vg2gt.types import Gaussians
    from vg2gt.viewer import ViewerScene

# next to scene.ply, as `vg2gt reconstruct` writes them
CAMERAS, VIEWS, IMAGE_FOLDER = "cameras.json", "views.npz", "images"


def main(argv: Sequence[str] | None = None) -> None:
    """Shows the scene; wrong arguments or files are reported in one line."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.html is not None and (arguments.host, arguments.port, arguments.share) != (None, None, False):
        parser.error("--html writes a file and starts no server; omit --host, --port and --share")
    known = arguments.scene.parent / CAMERAS
    if arguments.cameras is None and known.is_file():
        arguments.cameras = known
    if arguments.images is not None and arguments.cameras is None:
        parser.error("--images requires --cameras, which lists the image names")
    with errors_in_one_line():
        if arguments.html is None:
            from vg2gt.viewer.server import require_viser

            require_viser()  # before a scene is read
        scene = _scene(arguments)
        if arguments.html is None:
            _serve(scene, arguments)
        else:
            from vg2gt.viewer import write_viewer_html

            path = write_viewer_html(arguments.html, scene)
            print(f"{path}: {len(scene.gaussians)} Gaussians, {path.stat().st_size / 1e6:.1f} MB; open it in a browser")


def _parser() -> argparse.ArgumentParser:
    parser = flag_parser("view")
    add = parser.add_argument
    add("scene", type=Path, help="scene.ply or .spz")
    add("--cameras", type=Path, help="cameras, the first is the initial view; default: cameras.json next to the scene")
    add(
        "--images",
        type=Path,
        help="folder of the cameras' images; default: that of cameras.json, or images/ or views.npz in it",
    )
    add("--color", choices=("trust",), help="trust: colour by stated error and status of a scene.ply written by vg2gt")
    add("--html", type=Path, help="write one self-contained page to this file instead of serving")
    add("--title", help="title of the page; default: the scene's file name")
    add("--host", help="address to listen on; default: 127.0.0.1, this machine only")
    add("--port", type=_port, help="first port to try; default: 8080")
    add("--share", action="store_true", help="also publish the page through viser's public server")
    return parser


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port < 65536:
        raise ValueError(text)  # argparse writes the message
    return port


def _scene(arguments: argparse.Namespace) -> ViewerScene:
    from vg2gt.io import read_gaussians
    from vg2gt.reconstruction.camera_files import read_cameras
    from vg2gt.viewer import ViewerScene

    gaussians = read_gaussians(arguments.scene)
    if not len(gaussians):
        raise ValueError(f"{arguments.scene} holds no Gaussians")
    if arguments.color is not None:
        gaussians = _by_trust(arguments.scene, gaussians)
    title = arguments.title or arguments.scene.name
    if arguments.cameras is None:
        return ViewerScene(gaussians, title=title)
    cameras, near = read_cameras(arguments.cameras), arguments.cameras.parent
    sources = [arguments.images] if arguments.images is not None else [near, near / IMAGE_FOLDER, near / VIEWS]
    return ViewerScene(gaussians, cameras, _pictures(cameras, sources), title)


def _by_trust(path: Path, gaussians: Gaussians) -> Gaussians:
    """Colours the Gaussians by error bound and status, as reports do."""
    import torch

    from vg2gt.geometry.spherical_harmonics import rgb_to_sh
    from vg2gt.io.ply import read_properties
    from vg2gt.reconstruction.trust import trust_picture

    found = read_properties(path, "error", "support") if path.suffix == ".ply" else {}
    if len(found.get("support", ())) != len(gaussians):
        raise ValueError(f"{path} has no support per Gaussian: use a scene.ply written by vg2gt reconstruct")
    values = {name: torch.from_numpy(column).float() for name, column in found.items()}
    colors = trust_picture(values.get("error"), values["support"])  # [3, G]
    return replace(gaussians, sh=rgb_to_sh(colors.T)[:, None])


def _pictures(cameras: Sequence[NamedCamera], sources: Sequence[Path]) -> list[NDArray[np.uint8] | None]:
    """Loads the cameras' images from the first folder or views.npz that has any, and prints which."""
    from vg2gt.viewer.content import load_pictures, load_view_pictures

    for source in sources:
        pictures = (load_view_pictures if source.name == VIEWS else load_pictures)(cameras, source)
        found = sum(picture is not None for picture in pictures)
        if found:
            print(f"{found} of {len(cameras)} cameras have their image in {source}")
            return pictures
    looked = " or ".join(str(source) for source in sources)
    print(f"photographs are not shown: none in {looked} (reconstruct with --save views.npz, or --images DIR)")
    return []


def _serve(scene: ViewerScene, arguments: argparse.Namespace) -> None:
    from vg2gt.viewer.server import LOOPBACK, PORT, start_server

    server = start_server(
        scene,
        LOOPBACK if arguments.host is None else arguments.host,
        PORT if arguments.port is None else arguments.port,
        arguments.share,
    )
    try:
        print(f"http://{server.get_host()}:{server.get_port()} (Ctrl+C ends it)", flush=True)
        if arguments.share:
            url = server.request_share_url()
            print(f"published at {url}" if url else "could not be published", file=sys.stdout if url else sys.stderr)
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
