"""Training losses, combined by :class:`VG2GTLoss`."""

from vg2gt.losses.gaussian import GaussianLoss
from vg2gt.losses.geometry import GeometryLoss
from vg2gt.losses.objective import EnhancementLoss, LossReport, VG2GTLoss
from vg2gt.losses.truth import ScaleAlignment

__all__ = ["EnhancementLoss", "GaussianLoss", "GeometryLoss", "LossReport", "ScaleAlignment", "VG2GTLoss"]
