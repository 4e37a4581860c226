import torch

from vg2gt.metrics import depth_metrics, near_depth_edges


def test_three_pixels_on_either_side_of_a_step() -> None:
    depth = torch.full((1, 10, 20), 1.0)
    depth[..., 10:] = 1.2
    expected = torch.zeros(1, 10, 20, dtype=torch.bool)
    expected[..., 7:13] = True
    assert torch.equal(near_depth_edges(depth), expected)
    assert not near_depth_edges(depth, step=0.25).any()
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
