import torch

from vg2gt.evaluation.evaluator import SceneResult
from vg2gt.evaluation.pictures import PANELS, colorize_error, scene_picture
from vg2gt.types import Batch


def test_colours_of_the_depth_error() -> None:
    reference = torch.tensor([[2.0, 2.0, 2.0, 2.0, 0.0]])
    depth = torch.tensor([[2.0, 2.1, 2.4, 0.0, 3.0]])
    colors = colorize_error(depth, reference)
    assert colors[:, 0, 0].tolist() == [1, 1, 1]  # right: white
    torch.testing.assert_close(colors[:, 0, 1], torch.tensor([1.0, 0, 0]), atol=1e-5, rtol=0)  # 5 %: red
    assert colors[:, 0, 2].tolist() == [0, 0, 0]  # 10 % and more: black
    assert colors[2, 0, 3] > 0.8  # a hole: blue
    assert len(set(colors[:, 0, 4].tolist())) == 1  # unknown: grey


def test_a_grid_of_all_panels(result: SceneResult, batch: Batch) -> None:
    render = result.renders["gt_pose"]
    columns, gap, (height, width) = len(PANELS.split("|")), 4, batch.images.shape[-2:]
    for alignment in ("median", "scene", "wmed", "scale_shift", "none"):
        picture = scene_picture(batch, render, batch.target, alignment)
        assert picture.shape == (3, 3 * (height + gap) - gap, columns * (width + gap) - gap)
        assert picture.min() >= 0
        assert picture.max() <= 1
    torch.testing.assert_close(picture[:, :height, 2 * (width + gap) : 3 * width + 2 * gap], batch.target.images[0, 0])


def test_scenes_without_depth_have_pictures_too(result: SceneResult, batch: Batch) -> None:
    render = result.renders["gt_pose"]
    blind = batch.target.map(torch.clone)
    blind.depth.zero_()
    assert scene_picture(batch, render, blind, "median").isfinite().all()
