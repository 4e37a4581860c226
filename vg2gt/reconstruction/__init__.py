"""From images to a scene, and from a scene to files."""

from vg2gt.memory import OutOfMemory
from vg2gt.reconstruction.camera_paths import interpolate, orbit
from vg2gt.reconstruction.inputs import working_size
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.outputs import OUTPUTS, write_outputs
from vg2gt.reconstruction.pictures import find_pictures
from vg2gt.reconstruction.pipeline import reconstruct, reconstruct_with
from vg2gt.reconstruction.scene import RenderedView, Scene, ScenePoints, render_views
from vg2gt.runs.models import LoadedModel, load_model

__all__ = [
    "OUTPUTS",
    "LoadedModel",
    "Monitor",
    "OutOfMemory",
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
