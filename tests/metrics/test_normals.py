import math

import pytest
import torch

from vg2gt.metrics import normal_metrics


def tilted(degrees: torch.Tensor) -> torch.Tensor:
    """Normals ``[..., 3, H, W]`` tilted from -z towards x by the given angles ``[..., H, W]``."""
    angle = degrees.deg2rad()
    return torch.stack((angle.sin(), torch.zeros_like(angle), -angle.cos()), -3)


def test_angles_by_hand() -> None:
    angles = torch.tensor([[[0.0, 5, 20, 40, 100]]], dtype=torch.float64)
    reference = tilted(torch.zeros_like(angles))
    found = normal_metrics(3 * tilted(angles), reference, torch.ones_like(angles, dtype=torch.bool))
    cosine = float(angles.deg2rad().cos().mean())
    expected = {"mean": 33, "median": 20, "acc_10": 0.4, "acc_30": 0.6, "cosine": cosine}
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    small = torch.full((1, 4, 4), 1e-3)  # keep their precision in float32
    found = normal_metrics(tilted(small), tilted(0 * small), small > 0)
    assert found["mean"] == pytest.approx(1e-3, rel=1e-3)


def test_invalid_pixels_and_missing_normals_are_left_out_and_images_count_alike() -> None:
    angles = torch.zeros(3, 2, 4)
    angles[0] = 10
    angles[1, 0, 0] = 40
    predicted = tilted(angles)
    valid = torch.ones(3, 2, 4, dtype=torch.bool)
    valid[1] = False
    valid[1, 0, :2] = True
    predicted[1, :, 0, 1] = 0  # rendered nothing
    valid[2] = False  # an image without valid pixels
    found = normal_metrics(predicted, tilted(torch.zeros(3, 2, 4)), valid)
    assert found["mean"] == pytest.approx(25, rel=1e-5)
    nothing = normal_metrics(predicted, predicted, torch.zeros_like(valid))
    assert all(math.isnan(value) for value in nothing.values())
