"""Statistics over seeds, against scipy and by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from vg2gt.studies.study import estimate, over_seeds, paired_difference


def test_estimate_is_the_textbook_interval() -> None:
    values = [0.31, 0.28, 0.35, 0.30]
    found = estimate(values)
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert found.mean == pytest.approx(np.mean(values))
    assert found.mean - found.margin == pytest.approx(low)
    assert found.mean + found.margin == pytest.approx(high)


def test_differences_are_taken_seed_by_seed() -> None:
    """What seeds share cancels: a small difference shows although the seeds lie far apart."""
    full = {0: {"psnr": 20.0}, 1: {"psnr": 30.0}, 2: {"psnr": 25.0}, 7: {"psnr": 1.0}}
    variant = {2: {"psnr": 24.5}, 0: {"psnr": 19.4}, 1: {"psnr": 29.6}}
    change = paired_difference(variant, full, "psnr")
    assert change.mean == pytest.approx(-0.5)
    assert change.margin < 0.3
    assert over_seeds(variant, "psnr").margin > 10
    assert math.isnan(paired_difference(variant, full, "lpips").mean)
