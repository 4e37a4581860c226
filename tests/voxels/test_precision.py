"""Under autocast no network over voxels multiplies matrices of float32, forward or backward."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from vg2gt.method import sparse_conv

PRODUCTS = ("mm", "addmm", "bmm", "baddbmm", "mv", "addmv", "convolution", "convolution_backward")


class Products(TorchDispatchMode):
    """Notes the types of matrix products."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if name in PRODUCTS or "scaled_dot_product" in name or "mkldnn" in name:
            tensors = [arg for arg in args if isinstance(arg, torch.Tensor)]
            kinds = {arg.dtype for arg in (tensors[:1] if "attention" in name else tensors)}  # which adds logarithms
            self.seen += [f"{name} of {kind}" for kind in kinds]
        return func(*args, **(kwargs or {}))


@pytest.fixture(params=[True, False], ids=["cpu", "gpu"])
def one_by_one(request, monkeypatch):
    monkeypatch.setattr(sparse_conv, "one_by_one", lambda device: request.param)


@pytest.mark.parametrize("name", ["coarse", "dense head", "point MLP", "PTv3"])
def test_networks_multiply_in_bfloat16(name, one_by_one, make_room, make_coarse, make_fine):
    tokens, geometry, images = make_room()
    coarse, fine = make_coarse(surface_evidence=False, embedding_skip=False, fuse_kernel=1), make_fine()
    for parameter in coarse.zero.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    grid, batch = torch.cartesian_prod(*[torch.arange(6)] * 3), torch.zeros(216, dtype=torch.int64)
    size = torch.ones(1)
    networks = {
        "coarse": lambda: torch.cat(coarse(tokens, geometry).patch),
        "dense head": lambda: fine.dense_head(tokens, images),
        "point MLP": lambda: fine.point_mlp(torch.randn(216, fine.point_mlp.embed[0].in_features), grid, batch, size),
        "PTv3": lambda: coarse.ptv3(torch.randn(216, 13), grid, batch, size),
    }
    with Products() as products:
        with torch.autocast("cpu", torch.bfloat16):
            out = networks[name]()
        out.float().square().sum().backward()
    assert len(products.seen) > 10
    assert {seen for seen in products.seen if "bfloat16" not in seen} == set()
