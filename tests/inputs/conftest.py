"""The same rooms and photographs as for reconstruction."""

from tests.reconstruction.conftest import folder, frames, model, photos, ready, recording, run_folder

__all__ = ["folder", "frames", "model", "photos", "ready", "recording", "run_folder"]
