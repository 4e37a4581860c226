import math

import numpy as np
import pytest
import torch
from torch import Tensor

from vg2gt.metrics import depth_metrics, near_depth_edges, normal_metrics


def maps() -> tuple[Tensor, Tensor]:
    """Three images of 31 x 41 pixels with invalid references and holes."""
    rng = np.random.default_rng(0)
    reference = rng.uniform(1, 6, (3, 31, 41))
    predicted = reference * 0.4 * np.exp(0.08 * rng.standard_normal(reference.shape))
    reference[rng.random(reference.shape) < 0.2] = 0
    predicted[rng.random(reference.shape) < 0.1] = 0
    return torch.from_numpy(predicted), torch.from_numpy(reference)


def numpy_metrics(predicted: np.ndarray, reference: np.ndarray, scale) -> dict[str, float]:
    """One image at a time; ``scale`` gets the pixels that count."""
    rows = []
    for p, r in zip(predicted, reference, strict=True):
        usable, valid = r > 0, (r > 0) & (p > 0)
        d, g = scale(p[valid], r[valid]), r[valid]
        ratio = np.maximum(d / g, g / d)
        row = {
            "abs_rel": np.mean(np.abs(d - g) / g),
            "mae": np.mean(np.abs(d - g)),
            "rmse": np.sqrt(np.mean((d - g) ** 2)),
            "coverage": valid.sum() / usable.sum(),
        }
        for n in (1.25, 1.05, 1.03):
            row[f"delta_{n}"] = np.mean(ratio < n)
            row[f"delta_{n}_holes"] = np.sum(ratio < n) / usable.sum()
        rows.append(row)
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def lower_median(x: np.ndarray) -> float:
    return float(np.sort(x)[(len(x) - 1) // 2])


def test_matches_numpy_by_image_and_by_scene() -> None:
    predicted, reference = maps()
    predicted[1] *= 1.2
    valid = (predicted > 0) & (reference > 0)
    shared = lower_median((reference[valid] / predicted[valid]).numpy())
    for alignment, scale in {
        "median": lambda p, r: p * lower_median(r / p),
        "none": lambda p, r: p,
        "scene": lambda p, r: p * shared,
    }.items():
        found = depth_metrics(predicted, reference, alignment)
        assert found == pytest.approx(numpy_metrics(predicted.numpy(), reference.numpy(), scale), rel=1e-9), alignment
    assert found["abs_rel"] > depth_metrics(predicted, reference, "median")["abs_rel"]


def test_holes_lower_coverage_and_fail_the_delta_test_with_holes_only() -> None:
    reference = torch.full((2, 4, 5), 3.0)
    predicted = reference.clone()
    predicted[0, :2] = 0
    predicted[1] = 0  # nothing rendered
    found = depth_metrics(predicted, reference)
    assert (found["abs_rel"], found["delta_1.05"]) == (0, 1)
    assert [found["coverage"], found["delta_1.05_holes"]] == pytest.approx([0.25, 0.25])


def test_unusable_pixels_and_images_are_left_out() -> None:
    reference = torch.tensor([[[1.0, 2.0, 0.0, torch.inf]], [[0.0, 0.0, 0.0, torch.nan]]])
    predicted = torch.tensor([[[1.1, 2.2, 9.0, 9.0]], [[1.0, 1.0, 1.0, 1.0]]])
    found = depth_metrics(predicted, reference, "none")
    assert found["abs_rel"] == pytest.approx(0.1)
    assert found["coverage"] == 1
    nothing = depth_metrics(predicted, torch.zeros_like(reference))
    assert all(math.isnan(value) for value in nothing.values())


def test_three_pixels_on_either_side_of_a_step() -> None:
    depth = torch.full((1, 10, 20), 1.0)
    depth[..., 10:] = 1.2
    expected = torch.zeros(1, 10, 20, dtype=torch.bool)
    expected[..., 7:13] = True
    assert torch.equal(near_depth_edges(depth), expected)
    assert not near_depth_edges(depth.sqrt().sqrt()).any()
    assert torch.equal(near_depth_edges(1000 * depth.transpose(1, 2)), expected.transpose(1, 2))


def test_scores_of_a_region_are_aligned_by_all_pixels() -> None:
    truth = torch.full((1, 10, 20), 2.0)
    predicted = truth.clone() / 4
    region = torch.zeros(1, 10, 20, dtype=torch.bool)
    region[..., :3] = True
    predicted[region] *= 1.1
    for alignment in ("scene", "median"):
        inside = depth_metrics(predicted, truth, alignment, region=region)
        assert abs(inside["abs_rel"] - 0.1) < 1e-6, alignment
        assert abs(depth_metrics(predicted, truth, alignment, region=~region)["abs_rel"]) < 1e-6
    predicted[:, :5, :3] = 0
    assert depth_metrics(predicted, truth, "scene", region=region)["coverage"] == 0.5


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
