import torch

from vg2gt.evaluation.evaluator import SceneResult
from vg2gt.evaluation.pictures import PANELS, scene_picture
from vg2gt.types import Batch


def test_a_grid_of_all_panels(result: SceneResult, batch: Batch) -> None:
    render = result.renders["gt_pose"]
    columns, gap, (height, width) = len(PANELS.split("|")), 4, batch.images.shape[-2:]
    for alignment in ("median", "scene", "wmed", "scale_shift", "none"):
        picture = scene_picture(batch, render, batch.target, alignment)
        assert picture.shape == (3, 3 * (height + gap) - gap, columns * (width + gap) - gap)
        assert picture.min() >= 0
        assert picture.max() <= 1
    torch.testing.assert_close(picture[:, :height, 2 * (width + gap) : 3 * width + 2 * gap], batch.target.images[0, 0])
