"""``vg2gt view SCENE``: a scene in the browser, live or as one self-contained page (docs/view.md)."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io import read_cameras_json, read_gaussian_ply, read_splat
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.types import Gaussians
from vg2gt.viewer import MissingViserError, ViewerScene, load_pictures, start_server, write_viewer_html
from vg2gt.viewer.server import LOOPBACK, PORT

IMAGE_FOLDER = "images"  # beside cameras.json, as `vg2gt reconstruct --save images` writes it
READERS = {".ply": read_gaussian_ply, ".splat": read_splat}


def main() -> None:
    """Reads the arguments and shows the scene; what is wrong with them or the files ends it with one line."""
    parser = _parser()
    arguments = parser.parse_args()
    if arguments.html is not None and (arguments.host, arguments.port, arguments.share) != (None, None, False):
        parser.error("--html writes a file and serves nothing; leave out --host, --port and --share")
    if arguments.images is not None and arguments.cameras is None:
        parser.error("--images needs --cameras, which names them")
    try:
        scene = _scene(arguments)
        if arguments.html is None:
            _serve(scene, arguments)
        else:
            path = write_viewer_html(arguments.html, scene)
            print(f"{path}: {len(scene.gaussians)} Gaussians, {path.stat().st_size / 1e6:.1f} MB; open it in a browser")
    except (ValueError, OSError, MissingViserError) as error:
        parser.error(str(error))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="vg2gt view", description="Shows a scene of Gaussians in the browser.")
    parser.add_argument("scene", type=Path, help=f"Gaussians: {', '.join(READERS)}")
    parser.add_argument("--cameras", type=Path, help="cameras.json of the scene; the first one is the initial view")
    parser.add_argument(
        "--images", type=Path, help="folder of the cameras' images; default: that of cameras.json, or images/ in it"
    )
    parser.add_argument("--html", type=Path, help="write one self-contained page to this file instead of serving")
    parser.add_argument("--title", help="of the page; default: the scene's file name")
    parser.add_argument("--host", help=f"address to listen on; default: {LOOPBACK}, this machine only")
    parser.add_argument("--port", type=_port, help=f"first port to try; default: {PORT}")
    parser.add_argument("--share", action="store_true", help="also publish the page through viser's public server")
    return parser


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port < 65536:
        raise ValueError(text)  # argparse words the error
    return port


def _scene(arguments: argparse.Namespace) -> ViewerScene:
    gaussians = _read_gaussians(arguments.scene)
    title = arguments.title or arguments.scene.name
    if arguments.cameras is None:
        return ViewerScene(gaussians, title=title)
    cameras = read_cameras_json(arguments.cameras)
    beside = arguments.cameras.parent
    folders = [arguments.images] if arguments.images is not None else [beside, beside / IMAGE_FOLDER]
    return ViewerScene(gaussians, cameras, _pictures(cameras, folders), title)


def _pictures(cameras: Sequence[NamedCamera], folders: Sequence[Path]) -> list[NDArray[np.uint8] | None]:
    """The cameras' pictures from the first of the folders that has any; says where they are from."""
    for folder in folders:
        pictures = load_pictures(cameras, folder)
        found = sum(picture is not None for picture in pictures)
        if found:
            print(f"{found} of {len(cameras)} cameras have their image in {folder}")
            return pictures
    looked = " or ".join(str(folder) for folder in folders)
    print(f"0 of {len(cameras)} cameras have their image in {looked}; --images names another folder")
    return []


def _read_gaussians(path: Path) -> Gaussians:
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path}: expected one of {', '.join(READERS)} by its name")
    gaussians = read(path)
    if not len(gaussians):
        raise ValueError(f"{path} holds no Gaussians")
    return gaussians


def _serve(scene: ViewerScene, arguments: argparse.Namespace) -> None:
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


if __name__ == "__main__":
    main()
