from functools import partial

import pytest
import torch
from torch.nn import functional as F

from vg2gt.kernels.row_products import linear_rows


@pytest.mark.parametrize("shape", [(1024, 7), (1152, 7), (1153, 7), (48, 32, 7), (0, 7), (5, 7)])
@pytest.mark.parametrize("with_bias", [True, False])
@pytest.mark.parametrize("relu", [True, False])
def test_rows_go_through_the_same_layer(shape: tuple[int, ...], with_bias: bool, relu: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    values = [torch.randn(size, generator=generator, dtype=torch.float64) for size in (shape, (5, 7), (5,))]
    results = []
    for layer, dtype in ((partial(linear_rows, relu=relu), torch.float32), (F.linear, torch.float64)):
        x, weight, bias = (value.to(dtype).requires_grad_() for value in values)
        out = layer(x, weight, bias if with_bias else None)
        out = F.relu(out) if relu and layer is F.linear else out
        assert (out.shape, out.dtype) == ((*shape[:-1], 5), dtype)
        inputs = [x, weight, bias][: 2 + with_bias]
        results.append([out.detach(), *torch.autograd.grad(out.square().sum(), inputs)])
    for found, exact in zip(*results, strict=True):
        largest = 1e-5 * max(float(exact.abs().sum()), 1) ** 0.5
        torch.testing.assert_close(found.double(), exact, rtol=1e-5, atol=largest)
