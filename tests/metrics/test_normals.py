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
    assert found["mean"] == pytest.approx(33)
    assert found["median"] == pytest.approx(20)
    assert found["acc_10"] == pytest.approx(0.4)
    assert found["acc_30"] == pytest.approx(0.6)
    assert found["cosine"] == pytest.approx(sum(math.cos(math.radians(a)) for a in (0, 5, 20, 40, 100)) / 5)


def test_small_angles_keep_their_precision_in_float32() -> None:
    angles = torch.full((1, 4, 4), 1e-3)
    found = normal_metrics(tilted(angles), tilted(0 * angles), torch.ones(1, 4, 4, dtype=torch.bool))
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
