"""``vg2gt view SCENE``: writes a scene as one self-contained page for the browser (docs/guides/view.md)."""

from __future__ import annotations

import argparse
import webbrowser
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

CAMERAS, VIEWS = "cameras.json", "views.npz"  # next to scene.ply, as vg2gt reconstruct writes them


def main(argv: Sequence[str] | None = None) -> None:
    """Writes the page; wrong arguments or files are reported in one line."""
    parser = flag_parser("view")
    add = parser.add_argument
    add("scene", type=Path, help="a scene's folder, scene.ply, .spz, .glb or .gltf")
    add("--cameras", type=Path, help="cameras, the first is the initial view; default: cameras.json next to the scene")
    add("--images", type=Path, help="folder of the cameras' images; default: that of cameras.json, or views.npz in it")
    add("--color", choices=("trust",), help="trust: colour by stated error and status of a scene.ply written by vg2gt")
    add("--html", type=Path, metavar="FILE", help="the page to write; default: SCENE.html next to the scene")
    add("--open", action="store_true", help="open the page in the browser")
    add("--title", help="title of the page; default: the scene's name, of scene.ply its folder's")
    add("--levels", action="store_true", help="levels of detail in a folder next to the page, for a million Gaussians")
    with errors_in_one_line():
        run(parser.parse_args(argv))


def run(arguments: argparse.Namespace) -> None:
    """Reads the scene, writes the page and opens it if asked."""
    from vg2gt.inputs.camera_files import read_cameras
    from vg2gt.inputs.scene_cameras import cameras_of_scene
    from vg2gt.io import read_gaussians
    from vg2gt.outputs.output_names import LARGE
    from vg2gt.outputs.outputs import check_folder
    from vg2gt.outputs.saved import renderer_of, scene_file
    from vg2gt.rendering import Renderer
    from vg2gt.viewer import ViewerScene, scene_title, write_viewer_html

    file = scene_file(arguments.scene)
    page = arguments.html or file.with_suffix(".html")
    check_folder(page.parent, (), overwrite=True)
    known = file.parent / CAMERAS
    source = arguments.cameras or (known if known.is_file() else None)
    if arguments.images is not None and source is None:
        raise ValueError("--images requires --cameras, which lists the image names")
    gaussians = read_gaussians(file)
    if not len(gaussians):
        raise ValueError(f"{file} holds no Gaussians; there is nothing to show")
    if arguments.color is not None:
        gaussians = _by_trust(file, gaussians)
    title = arguments.title or scene_title(file)
    renderer = renderer_of(file.parent, Renderer())
    scene = ViewerScene(gaussians, title=title, near=renderer.near, antialiased=renderer.antialiased)
    if source is not None:
        cameras = cameras_of_scene(read_cameras(source), file, gaussians)
        sources = [source.parent, source.parent / VIEWS] if arguments.images is None else [arguments.images]
        scene = replace(scene, cameras=cameras, pictures=_pictures(cameras, sources))
    path = write_viewer_html(page, scene, arguments.levels)
    print(f"{path}: {len(gaussians)} Gaussians, {path.stat().st_size / 1e6:.1f} MB; open it in a browser")
    if len(gaussians) > LARGE and not arguments.levels:
        print("with --levels, the page of a scene of this size loads and draws only what is needed for a view")
    if arguments.open:
        webbrowser.open(path.resolve().as_uri())


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
    from vg2gt.viewer import load_pictures

    for source in sources:
        pictures = load_pictures(cameras, source)
        if found := sum(picture is not None for picture in pictures):
            print(f"{found} of {len(cameras)} cameras have their image in {source}")
            return pictures
    looked = " or ".join(str(source) for source in sources)
    print(f"photographs are not shown: none in {looked} (reconstruct with --save views.npz, or --images DIR)")
    return []
