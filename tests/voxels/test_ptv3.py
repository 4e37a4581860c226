import pytest
import torch

from tests.references import draw_weights, read_cases, read_json
from vg2gt.method import PTv3
from vg2gt.method.ptv3 import _Residual

SIZE = torch.full((2,), 0.125)


@pytest.fixture
def voxels(random_voxels):
    grid, batch = random_voxels()
    features = torch.randn(len(grid), 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return features, grid, batch, SIZE


def test_orders_are_shuffled_in_training_only_and_from_the_generator(voxels, make_ptv3):
    net = make_ptv3().double()

    def run(seed):
        return net(*voxels, generator=None if seed is None else torch.Generator().manual_seed(seed))

    net.train()
    results = [run(seed) for seed in range(4)]
    assert torch.equal(results[0], run(0))
    assert any(not torch.equal(results[0], other) for other in results[1:])
    assert torch.equal(run(None), net.eval()(*voxels))
    assert torch.equal(run(0), run(1))


def test_batch_norm_of_one_voxel_uses_the_running_statistics(voxels, make_ptv3):
    net = make_ptv3(norm="batch").double().train()
    features, grid, batch, size = voxels
    one = (features[:1], grid[:1], batch[:1], size)
    assert net(*one).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_residual_in_one_operation_equals_the_plain_one(dtype):
    features, probe = torch.randn(2, 50, 8)
    change, kept = torch.randn(50, 8).to(dtype), torch.empty(50, 1).bernoulli_(0.7) / 0.7
    found, expected = ([x.clone().requires_grad_() for x in (features, change)] for _ in range(2))
    out, plain = _Residual.apply(*found, kept), expected[0] + expected[1] * kept
    torch.testing.assert_close(out, plain)
    of_found, of_expected = torch.autograd.grad(out, found, probe), torch.autograd.grad(plain, expected, probe)
    assert all(torch.equal(one, other) for one, other in zip(of_found, of_expected, strict=True))


def test_drop_path_acts_in_training_only(voxels, make_ptv3):
    net = make_ptv3(drop_path=0.5).double()
    torch.manual_seed(0)
    assert not torch.equal(net(*voxels), net(*voxels))
    assert torch.equal(net.eval()(*voxels), make_ptv3().double().eval()(*voxels))


@pytest.mark.parametrize("case", [0, 1])
def test_equals_the_official_code(case):
    net = PTv3(**read_json("networks")["ptv3_tiny"]["config"], norm="batch", legacy=True).eval()
    counters = {name: value for name, value in net.state_dict().items() if name.endswith("num_batches_tracked")}
    net.load_state_dict(draw_weights("ptv3_tiny") | counters)
    features, grid, batch, expected = (
        read_cases("ptv3_tiny")[f"{case}.{name}"] for name in ("features", "grid", "batch", "output")
    )
    out = net(features, grid, batch, torch.ones(case + 1))
    assert (out - expected).abs().max() <= 2e-5 * expected.abs().max()
