"""Bounds hold as often as they say, whatever the backbone's confidence is worth."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from vg2gt.evaluation.scene_metrics import ause
from vg2gt.io.errors import FormatError
from vg2gt.uncertainty import LEVELS, Calibration, Samples, calibrate, read_calibration
from vg2gt.uncertainty.calibration import MEASURED, increasing_quantiles
from vg2gt.visibility import Status
from vg2gt.visibility.evidence import EVIDENCE


def pixels(seed: int, scenes: int = 20, each: int = 8000, useful: bool = True) -> Samples:
    """Errors whose spread depends on the first two kinds of evidence and the status, or on nothing that is known."""
    generator = torch.Generator().manual_seed(seed)
    count = scenes * each
    evidence = torch.randn(count, len(EVIDENCE), generator=generator)
    evidence[:, 3] = 0.0  # never varies, as views that look through where none does
    differ = torch.arange(scenes) % 5 == 0  # views differ much, and errors are five times as large
    evidence[:, -1] = torch.where(differ, 0.02, 0.004).log().repeat_interleave(each)
    status = torch.tensor(MEASURED)[torch.randint(3, (count,), generator=generator)]
    hidden = torch.randn(count, 2, generator=generator)
    cause = evidence[:, :2] if useful else hidden
    spread = torch.where(evidence[:, -1].exp() > 0.01, 0.1, 0.02) * (6 - status) / 2
    spread *= torch.exp(0.8 * cause[:, 0] - 0.5 * cause[:, 1].abs())
    error = (spread * torch.randn(count, generator=generator)).abs()
    return Samples(evidence, status, error, torch.arange(count) // each)


@pytest.fixture(scope="module")
def made() -> Calibration:
    return calibrate(pixels(0), "weights")


@pytest.mark.parametrize("useful", [True, False], ids=["evidence tells", "evidence tells nothing"])
def test_bounds_hold_as_often_as_they_say(useful: bool) -> None:
    made, fresh = calibrate(pixels(0, useful=useful), "weights"), pixels(1, useful=useful)
    bounds = made.bounds(fresh.evidence, fresh.status)
    for level, bound in zip(LEVELS, bounds, strict=True):
        for kind in MEASURED:
            held = (fresh.error <= bound)[fresh.status == kind].float().mean()
            assert held == pytest.approx(level, abs=0.02)
        for differ in (fresh.evidence[:, -1].exp() > 0.01, fresh.evidence[:, -1].exp() < 0.01):
            assert (fresh.error <= bound)[differ].float().mean() == pytest.approx(level, abs=0.02)
    assert (bounds.diff(dim=0) >= 0).all()


def test_bounds_are_wide_where_errors_are_large(made: Calibration) -> None:
    fresh = pixels(1)
    bound = made.error(fresh.evidence, fresh.status)
    for part in (fresh.evidence[:, 0] > 1, fresh.evidence[:, 0] < -1):
        assert (fresh.error <= bound)[part].float().mean() == pytest.approx(0.9, abs=0.02)
    assert ause(fresh.error, bound) < 0.5 * ause(fresh.error, torch.rand(len(bound)))


def test_what_has_no_depth_is_unknown(made: Calibration) -> None:
    status = torch.tensor([[Status.GUESSED, Status.UNSEEN, Status.AGREED]])
    error = made.error(torch.zeros(1, 3, len(EVIDENCE)), status)
    assert error.shape == (1, 3)
    assert error[0, :2].isinf().all()
    assert error[0, 2] < 1


def test_bounds_hold_for_errors_with_heavy_tails() -> None:
    """A quarter of the errors exceeds 1, and the 95 % bound has to be far above it."""

    def heavy(seed: int) -> Samples:
        samples = pixels(seed)
        uniform = torch.rand(len(samples.error), generator=torch.Generator().manual_seed(seed)).double()
        return replace(samples, error=(0.25 / (1 - uniform)).float())  # Pareto: P(error > x) = 0.25 / x

    made, fresh = calibrate(heavy(0), "weights"), heavy(1)
    bounds = made.bounds(fresh.evidence, fresh.status)
    for level, bound in zip(LEVELS, bounds, strict=True):
        assert float((fresh.error <= bound).float().mean()) == pytest.approx(level, abs=0.01)


def test_bins_in_the_wrong_order_are_pooled() -> None:
    bins = [torch.full((9,), value) for value in (0.1, 0.4, 0.2, 0.3, 0.5)]
    assert increasing_quantiles(bins, 0.9).tolist() == pytest.approx([0.1, 0.4, 0.4, 0.4, 0.5])
    assert increasing_quantiles(bins, 0.5).tolist() == pytest.approx([0.1, 0.3, 0.3, 0.3, 0.5])


def test_it_is_the_same_from_a_file(made: Calibration, tmp_path: Path) -> None:
    back, fresh = read_calibration(made.write(tmp_path / "made.json")), pixels(2, each=100)
    assert (back.made_for, back.scenes) == ("weights", 20)
    found, expected = (calibration.bounds(fresh.evidence, fresh.status) for calibration in (back, made))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6)


def test_damaged_files_are_refused(made: Calibration, tmp_path: Path) -> None:
    whole = made.write(tmp_path / "made.json").read_text()
    changes = (('"agreed"', '"agree"'), ('"confidence"', '"trust"'), ('"bounds"', '"bound"'), ("{", "["))
    damaged = [whole.replace(old, new, 1) for old, new in changes]
    for text in (*damaged, re.sub(r'("bounds": \[\s+\[\s+)[^,]+', r"\1NaN", whole)):
        assert text != whole
        (tmp_path / "made.json").write_text(text)
        with pytest.raises(FormatError, match=r"made.json is not a calibration.*vg2gt calibrate"):
            read_calibration(tmp_path / "made.json")


def test_few_scenes_or_pixels_are_refused() -> None:
    for few, said in (({"scenes": 3}, "3 scenes"), ({"each": 20}, "400 pixels")):
        with pytest.raises(ValueError, match=said):
            calibrate(pixels(0, **few), "weights")


def test_a_status_without_pixels_takes_the_curve_of_all() -> None:
    samples = pixels(0)
    made = calibrate(samples.select(samples.status == Status.AGREED), "weights")
    rare = torch.full((2,), int(Status.SINGLE), dtype=torch.uint8)
    assert (made.error(samples.evidence[:2], rare) < 1).all()
