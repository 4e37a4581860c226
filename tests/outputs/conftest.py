"""The same scene and recording as for reconstruction."""

from tests.reconstruction.conftest import frames, ready, recording, scene

__all__ = ["frames", "ready", "recording", "scene"]
