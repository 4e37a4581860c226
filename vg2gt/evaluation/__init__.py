"""Evaluation: figures of one scene, of data sets, and their report."""

from vg2gt.data.views.drawn import ViewSelection
from vg2gt.evaluation.evaluator import SceneEvaluator, SceneResult, evaluate_scene
from vg2gt.evaluation.options import EvaluationOptions, PointOptions

__all__ = [
    "EvaluationOptions",
    "PointOptions",
    "SceneEvaluator",
    "SceneResult",
    "ViewSelection",
    "evaluate_scene",
]
