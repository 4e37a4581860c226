import pytest
import torch

from vg2gt.metrics import cv


def cloud(count: int = 200) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("k", [1, 8])
def test_matches_brute_force(k: int) -> None:
    points = cloud().double()
    distances = torch.cdist(points, points).sort(-1).values[:, 1 : k + 1].mean(-1)
    assert cv(points, k) == pytest.approx(float(distances.std(correction=0) / distances.mean()), rel=1e-6)


def test_a_draw_of_queries_is_seeded_and_searches_the_whole_cloud() -> None:
    points = cloud(4000)
    full, drawn = cv(points), cv(points, max_queries=1500, seed=3)
    assert drawn == cv(points, max_queries=1500, seed=3)
    assert drawn != cv(points, max_queries=1500, seed=4)
    # Thinning the cloud itself would lengthen all distances and change the figure's meaning.
    assert drawn == pytest.approx(full, rel=0.1)
    assert cv(points, max_queries=4000) == full
