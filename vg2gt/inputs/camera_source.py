"""Where the cameras of a scene come from."""

from __future__ import annotations

from enum import Enum

from vg2gt.inputs.pictures import SFM_SOURCE

RECORDING = "RGB-D recording"  # begins the description of cameras that were measured together with depth


class CameraSource(Enum):
    """Kind of origin of a scene's cameras, which decides its frame and its refinement."""

    PREDICTED = "predicted"
    """The backbone predicted them."""
    FOUND = "found"
    """Structure from motion found them in the photographs."""
    RECORDED = "recorded"
    """An RGB-D device measured them together with depth: they fit it better than bundle adjustment does."""
    GIVEN = "given"
    """They come from other files next to the photographs."""

    @classmethod
    def of(cls, described: str) -> CameraSource:
        """Returns the kind of a description, as pictures (:attr:`Picture.source`), scenes and reports hold it."""
        if not described:
            return cls.PREDICTED
        if described.startswith(SFM_SOURCE):
            return cls.FOUND
        return cls.RECORDED if described.startswith(RECORDING) else cls.GIVEN
