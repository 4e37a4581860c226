"""Viewers of a scene: a self-contained HTML page, or a viser server."""

from vg2gt.viewer.content import ViewerScene, load_pictures
from vg2gt.viewer.page import write_viewer_html
from vg2gt.viewer.server import start_server

__all__ = [
    "ViewerScene",
    "load_pictures",
    "start_server",
    "write_viewer_html",
]
