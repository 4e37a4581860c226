"""Which views of a scene are taken: one record (``SceneSample``), three ways to choose.

* ``sampling``: training; drawn from the seed and the step's number (``ViewSampler``, ``StepSampler``). Used by the data
  module.
* ``even``: evaluation during training; spread evenly, or at fixed positions (``EvaluationViews``, the ``data.eval_*``
  options). Used by the data module.
* ``drawn``: evaluation by itself (``vg2gt evaluate``); drawn from the scene's name, or read from an index of frame ids
  in ``indices/`` (``ViewSelection``, the ``evaluation.selection`` options). Used by ``vg2gt.evaluation``, and by
  ``vg2gt data views``, which writes such indices.
"""

from vg2gt.data.views.sample import SceneSample

__all__ = ["SceneSample"]
