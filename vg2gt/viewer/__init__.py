"""The viewer of a scene: one self-contained HTML page."""

from vg2gt.viewer.content import ViewerScene, load_pictures, scene_title, thumbnail
from vg2gt.viewer.page import write_viewer_html

__all__ = ["ViewerScene", "load_pictures", "scene_title", "thumbnail", "write_viewer_html"]
