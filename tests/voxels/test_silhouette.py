import pytest
import torch

from vg2gt.method.additions.silhouette import near_silhouettes, on_surface


def _blurred_step(near: float, far: float) -> torch.Tensor:
    """A foreground and a background with two pixels between them, ``[1, 12, 16]``."""
    row = torch.tensor([near] * 7 + [0.8 * near + 0.2 * far, 0.2 * near + 0.8 * far] + [far] * 7)
    return row.expand(1, 12, 16).clone()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_pixels_between_foreground_and_background_are_told_apart(turned: bool, unit: float) -> None:
    depth = unit * _blurred_step(1.0, 2.0)
    depth = depth.transpose(-1, -2) if turned else depth
    found = on_surface(depth)
    found = found.transpose(-1, -2) if turned else found
    expected = torch.ones(1, 12, 16, dtype=torch.bool)
    expected[..., 7:9] = False
    assert torch.equal(found, expected)


@pytest.mark.parametrize(("step", "beside"), [(1.14, False), (1.16, True)])
def test_three_pixels_on_either_side_of_a_step_are_beside_it(step: float, beside: bool) -> None:
    depth = torch.full((2, 12, 16), 2.0)
    depth[..., 8:] *= step
    expected = torch.zeros(2, 12, 16, dtype=torch.bool)
    expected[..., 5:11] = beside
    assert torch.equal(near_silhouettes(depth), expected)


def test_what_lies_between_foreground_and_background_is_beside_a_silhouette() -> None:
    depth = _blurred_step(1.0, 1.12)  # too small a step for a surface to break off
    expected = torch.zeros(1, 12, 16, dtype=torch.bool)
    expected[..., 7:9] = True
    assert torch.equal(near_silhouettes(depth), expected)
