import torch

from vg2gt.evaluation.evaluator import SceneResult
from vg2gt.evaluation.pictures import PANELS, scene_picture
from vg2gt.types import Batch


def test_a_grid_of_all_panels(result: SceneResult, batch: Batch) -> None:
    render = result.renders["gt_pose"]
    columns, gap, (height, width) = len(PANELS.split("|")), 4, batch.images.shape[-2:]
    picture = scene_picture(batch, render, batch.target)
    assert picture.shape == (3, 3 * (height + gap) - gap, columns * (width + gap) - gap)
    assert picture.min() >= 0
    assert picture.max() <= 1
    torch.testing.assert_close(picture[:, :height, -width:], batch.target.images[0, 0])
