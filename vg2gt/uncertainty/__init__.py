"""Uncertainty of a scene: a status and a calibrated error bound for every depth."""

from vg2gt.uncertainty.calibration import LEVELS, STATED, Calibration, Samples, calibrate, read_calibration
from vg2gt.uncertainty.evidence import Status, pixel_evidence, point_support

__all__ = [
    "LEVELS",
    "STATED",
    "Calibration",
    "Samples",
    "Status",
    "calibrate",
    "pixel_evidence",
    "point_support",
    "read_calibration",
]
