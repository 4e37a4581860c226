"""Evaluation: figures of one scene, of data sets, and their report."""

from vg2gt.evaluation.options import EvaluationOptions, PointOptions
from vg2gt.evaluation.scene import SceneEvaluator, SceneResult, evaluate_scene
from vg2gt.evaluation.views import ViewSelection

__all__ = [
    "EvaluationOptions",
    "PointOptions",
    "SceneEvaluator",
    "SceneResult",
    "ViewSelection",
    "evaluate_scene",
]
