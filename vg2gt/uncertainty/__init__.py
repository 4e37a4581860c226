"""Calibrated error bounds of depth, from the evidence of :mod:`vg2gt.visibility`."""

from vg2gt.uncertainty.calibration import LEVELS, MEASURED, STATED, Calibration, Samples, calibrate, read_calibration

__all__ = [
    "LEVELS",
    "MEASURED",
    "STATED",
    "Calibration",
    "Samples",
    "calibrate",
    "read_calibration",
]
