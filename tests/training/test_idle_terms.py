import logging

import pytest
import torch

from vg2gt.losses import GaussianLoss, VG2GTLoss
from vg2gt.losses.enhancement import EnhancementLoss
from vg2gt.training.idle_terms import IdleTerms


def test_a_weighted_term_that_never_acts_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    idle = IdleTerms(("depth_consistency", "ssim", "enhance_depth"), patience=5)
    with caplog.at_level(logging.WARNING):
        for step in range(20):
            hinge = torch.tensor(float(step % 4 == 3))  # acts now and then
            idle.see({"depth_consistency": torch.tensor(0.0), "ssim": torch.tensor(0.1), "enhance_depth": hinge})
    assert [record.getMessage().split(" has a weight")[0] for record in caplog.records] == [
        "the loss term depth_consistency"
    ]


def test_a_hinge_that_rests_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    idle = IdleTerms(("enhance_depth",), patience=5)
    with caplog.at_level(logging.INFO):
        for _ in range(20):
            idle.see({"enhance_depth": torch.tensor(0.0)})
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert "enhance_depth has rested for 5 steps" in record.getMessage()


def test_the_objective_names_its_weighted_terms() -> None:
    gaussian = ("color_l1", "ssim", "depth_consistency", "depth_gt", "normal")
    assert VG2GTLoss().weighted == ("enhance_depth", "enhance_point", *gaussian)
    some = VG2GTLoss(enhance=EnhancementLoss(weight=0), gaussian=GaussianLoss(depth_consistency=0, normal=0))
    assert some.weighted == ("color_l1", "ssim", "depth_gt")
    assert VG2GTLoss(gaussian=GaussianLoss(weight=0)).weighted == ("enhance_depth", "enhance_point")
