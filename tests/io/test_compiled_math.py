"""What compiled kernels calculate with, against the library's functions."""

import numba
import numpy as np
import torch
from torch.nn import functional as F

from vg2gt.kernels.compiled_math import exp, gelu


@numba.njit
def exponentials(values):
    results = np.empty_like(values)
    for i in range(len(values)):
        results[i] = exp(values[i])
    return results


@numba.njit
def gelus(values):
    results, slopes = np.empty_like(values), np.empty_like(values)
    for i in range(len(values)):
        results[i], slopes[i] = gelu(values[i])
    return results, slopes


def test_exp_of_what_is_not_positive() -> None:
    for dtype, least, relative in ((np.float32, -40, 3e-7), (np.float64, -80, 1e-15)):
        values = np.linspace(least, 0, 100_001).astype(dtype)
        exact = np.exp(values.astype(np.float64))
        assert np.abs(exponentials(values) / exact - 1).max() < relative


def test_exp_in_float32_leaves_room_for_products_that_are_not_denormal() -> None:
    """Which some processors calculate a hundred times as slowly."""
    results = exponentials(np.array([-40, -41, -87, -104, -1e4, -np.inf], np.float32))
    assert (results == results[0]).all()
    assert results[0] ** 2 > np.finfo(np.float32).tiny
    assert results[0] < np.finfo(np.float32).eps ** 2


def test_gelu_and_its_slope() -> None:
    values = np.concatenate((np.linspace(-12, 12, 200_001), [0, -1e-30, 1e-30, -1e4, 1e4])).astype(np.float32)
    results, slopes = gelus(values)
    x = torch.from_numpy(values).double().requires_grad_()
    exact = F.gelu(x)
    exact.sum().backward()
    error = np.abs(results - exact.detach().numpy())
    assert (error <= 5e-7 * np.maximum(1, np.abs(values))).all(), error.max()
    assert np.abs(slopes - x.grad.numpy()).max() < 4e-7
