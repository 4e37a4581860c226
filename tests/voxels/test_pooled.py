"""Voxels pooled in parts and merged are those of all views at once."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from tests.voxels.conftest import take_views
from vg2gt.method.pooled import merge


@pytest.mark.parametrize("moments", [False, True])
@torch.no_grad()
def test_parts_merge_into_what_all_views_give(make_fine, make_room, moments):
    module = make_fine(moments=moments, normal_kernel=3)
    inputs = make_room(views=5)
    size = torch.tensor([0.125])
    whole = module(*inputs)
    parts = [module.pool(*take_views(inputs, views), size, capped=False) for views in ([0, 1], [2], [3, 4])]
    pooled = merge(parts)
    assert len(pooled) < sum(map(len, parts))
    ours = module.refine(pooled, size)
    assert torch.equal(ours.grid, whole.grid)
    assert torch.equal(ours.count, whole.count)
    assert torch.equal(ours.confidence, whole.confidence)
    assert_close(ours.colors, whole.colors, atol=1e-6, rtol=0)
    assert_close(ours.centroid, whole.centroid, atol=1e-6, rtol=0)
    assert_close(ours.features, whole.features, atol=2e-4, rtol=1e-4)
    if moments:
        assert_close(ours.moments.spread, whole.moments.spread, atol=1e-6, rtol=0)
        assert_close(ours.moments.cross, whole.moments.cross, atol=1e-6, rtol=0)
        turned = (ours.moments.normal * whole.moments.normal).sum(-1)
        assert turned.quantile(0.01) > 0.999
    pairs = zip(vars(pooled).values(), vars(merge(parts)).values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs if a is not None)


@torch.no_grad()
def test_a_voxel_of_one_part_stays_as_it_is(make_fine, make_room):
    module, inputs = make_fine(moments=True), make_room(views=3)
    size = torch.tensor([0.125])
    part = module.pool(*inputs, size, capped=False)
    whole = module(*inputs)
    ours = module.refine(merge([part.rows(slice(0, 0)), part]), size)
    for name in ("features", "colors", "centroid"):
        assert torch.equal(getattr(ours, name), getattr(whole, name))
    other = part.rows(slice(0, 3))
    far = replace(other, grid=other.grid + 1000)
    assert torch.equal(merge([part, far]).features[: len(part)], part.features)


@torch.no_grad()
def test_the_cap_holds_for_merged_voxels(make_fine, make_room):
    inputs, size = make_room(views=4), torch.tensor([0.125])
    module = make_fine(max_voxels=50)
    whole = module(*inputs)
    parts = [module.pool(*take_views(inputs, views), size, capped=False) for views in ([0, 1], [2, 3])]
    assert torch.equal(module.refine(module.limited(merge(parts)), size).grid, whole.grid)
