"""What a scene knows and does not know: a status and a calibrated bound of the error of every depth."""

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
