import math

import numpy as np
import pytest
import torch
from torch import Tensor

from vg2gt.metrics import depth_metrics


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


def by_weighted_median(p: np.ndarray, r: np.ndarray) -> np.ndarray:
    scales = r / p
    costs = [np.sum(np.abs(s * p - r) / r) for s in scales]
    return p * scales[int(np.argmin(costs))]


def test_matches_numpy_by_image_and_by_scene() -> None:
    predicted, reference = maps()
    predicted[1] *= 1.2
    valid = (predicted > 0) & (reference > 0)
    shared = lower_median((reference[valid] / predicted[valid]).numpy())
    for alignment, scale in {
        "median": lambda p, r: p * lower_median(r / p),
        "wmed": by_weighted_median,
        "scale_shift": lambda p, r: np.polyval(np.polyfit(p, r, 1), p),
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
