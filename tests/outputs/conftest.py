"""The same scene and recording as for reconstruction."""

from tests.reconstruction.conftest import folder, frames, model, ready, recording, scene

__all__ = ["folder", "frames", "model", "ready", "recording", "scene"]
