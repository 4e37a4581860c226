import math

import pytest
import torch

from vg2gt.kernels import knn
from vg2gt.metrics import cv, point_metrics
from vg2gt.metrics.points import thin


def cloud(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("cap", [None, 0.05])
def test_matches_brute_force(cap: float | None) -> None:
    predicted, reference = cloud(300, 0), cloud(400, 1)
    distances = torch.cdist(predicted, reference)
    there, back = distances.amin(1), distances.amin(0)
    found = point_metrics(predicted, reference, threshold=0.06, cap=cap)
    kept = [d if cap is None else d[d < cap] for d in (there, back)]
    precision, recall = float((there < 0.06).double().mean()), float((back < 0.06).double().mean())
    expected = {
        "accuracy": float(kept[0].mean()),
        "completeness": float(kept[1].mean()),
        "chamfer": float(kept[0].mean() + kept[1].mean()) / 2,
        "precision": precision,
        "recall": recall,
        "f_score": 2 * precision * recall / (precision + recall),
    }
    assert found == pytest.approx(expected, rel=1e-9)


def test_thinning_keeps_one_point_per_cell() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.6, 0, 0], [0.0, 0.6, 0], [0.05, 0.05, 0.05]])
    assert thin(points, 0.5).tolist() == points[[0, 2, 3]].tolist()
    dense = torch.cat((cloud(50, 0), cloud(50, 0) + 1e-6))
    assert point_metrics(dense, cloud(50, 0), 0.1, downsample=1e-3)["accuracy"] < 1e-6


@pytest.mark.parametrize("k", [1, 8])
def test_uniformity_matches_brute_force(k: int) -> None:
    points = cloud(200, 0)
    distances = torch.cdist(points, points).sort(-1).values[:, 1 : k + 1].mean(-1)
    assert cv(points, k) == pytest.approx(float(distances.std(correction=0) / distances.mean()), rel=1e-6)


def test_a_draw_of_queries_is_seeded_and_searches_the_whole_cloud() -> None:
    points = cloud(4000, 0)
    full, drawn = cv(points), cv(points, max_queries=1500, seed=3)
    assert drawn == cv(points, max_queries=1500, seed=3)
    assert drawn != cv(points, max_queries=1500, seed=4)
    # Thinning the cloud itself would lengthen all distances and change the figure's meaning.
    assert drawn == pytest.approx(full, rel=0.1)
    assert cv(points, max_queries=4000) == full


@pytest.mark.parametrize("compiled", [True, False], ids=["tree", "cells"])
def test_a_cloud_in_one_place_or_with_a_hole_has_no_uniformity(compiled: bool, monkeypatch) -> None:
    """The search is by a tree on a CPU, and by cells on a GPU."""
    points = cloud(200, 0).float()
    expected = cv(points)
    monkeypatch.setattr(knn, "compilable", lambda *_: compiled)
    assert cv(points) == pytest.approx(expected, rel=1e-12)
    assert math.isnan(cv(points[:8]))
    assert math.isnan(cv(torch.ones_like(points)))
    assert math.isnan(cv(torch.cat((points, points[:1] * math.nan))))
