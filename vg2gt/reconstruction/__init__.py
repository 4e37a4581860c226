"""From images to a scene, and from a scene to files."""

from vg2gt.memory import OutOfMemory
from vg2gt.reconstruction.models import Ready, load_model
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.outputs import OUTPUTS, write_outputs
from vg2gt.reconstruction.paths import interpolate, orbit
from vg2gt.reconstruction.pictures import find_pictures
from vg2gt.reconstruction.pipeline import reconstruct, reconstruct_with
from vg2gt.reconstruction.scene import RenderedView, Scene, ScenePoints, render_views
from vg2gt.reconstruction.views import working_size

__all__ = [
    "OUTPUTS",
    "Monitor",
    "OutOfMemory",
    "Ready",
    "RenderedView",
    "Scene",
    "ScenePoints",
    "find_pictures",
    "interpolate",
    "load_model",
    "orbit",
    "reconstruct",
    "reconstruct_with",
    "render_views",
    "working_size",
    "write_outputs",
]
