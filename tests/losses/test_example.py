"""examples/loss.py adds a term, as docs/contributing.md says: weighted, summed and named."""

import torch
from hydra.utils import instantiate

from examples.loss import OpaqueGaussianLoss
from vg2gt.config import compose
from vg2gt.losses import GaussianLoss
from vg2gt.losses.gaussian import RenderTargets
from vg2gt.types import Cameras, Render


def test_a_term_of_ones_own_is_weighted_summed_and_named() -> None:
    size = (14, 18)
    depth = torch.ones(1, *size)
    rendered = Render(torch.rand(1, 1, 3, *size), depth[None], torch.ones(1, 1, 3, *size), 0.75 * depth[None])
    k = torch.tensor([[20.0, 0, 8.5], [0, 20, 6.5], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], k[None, None], size)
    known = depth > 0
    targets = RenderTargets(torch.rand(1, 3, *size), depth, known, k[None], depth, depth, known, known[:, :1, :1])
    config = ["loss.gaussian._target_=examples.loss.OpaqueGaussianLoss", "+loss.gaussian.opaque=0.5"]
    loss = instantiate(compose("train", "output_dir=unused", *config).loss).gaussian
    assert isinstance(loss, OpaqueGaussianLoss)
    terms = loss(rendered, cameras, targets, torch.ones(1))
    plain = GaussianLoss(**{name: getattr(loss, name) for name in GaussianLoss.__dataclass_fields__})
    before = plain(rendered, cameras, targets, torch.ones(1))
    torch.testing.assert_close(terms["opaque"], torch.tensor(0.25))
    assert terms.keys() - before.keys() == {"opaque"}
    torch.testing.assert_close(loss.total(terms), plain.total(before) + loss.weight * 0.5 * 0.25)
