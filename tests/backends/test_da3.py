import pytest
import torch
from hydra.errors import InstantiationException
from torch.utils._python_dispatch import TorchDispatchMode

import backends.da3.backend
import backends.network
import backends.vggt
from backends.da3.backend import normalize_cameras
from backends.da3.metric import fit_scale
from vg2gt.geometry.cameras import invert_rigid, relative_to_first
from vg2gt.types import Cameras, Geometry, Hints, Tokens

SIZE = (56, 84)
HEADS = ("pretrained=false", "dim=48", "num_heads=3", "features=24", "out_channels=[16,20,28,32]", "image_size=70")
TINY_METRIC = (*HEADS, "depth=4", "taps=[0,1,2,3]")


class Casts(TorchDispatchMode):
    """Counts copies of weights to bfloat16."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.weights = {parameter.data_ptr() for parameter in network.parameters()}
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.overloadpacket.__name__ == "_to_copy" and (kwargs or {}).get("dtype") == torch.bfloat16:
            self.count += args[0].data_ptr() in self.weights
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", ["da3_tiny", "vggt_tiny"])
def test_frozen_weights_are_stored_as_autocast_takes_them(name: str, make_backend, make_scene, monkeypatch) -> None:
    """On a GPU; here autocast of the CPU is made to take its place. Equal to the bit, and no cast in any later pass."""
    images, _ = make_scene(1, 2, SIZE)
    backend = make_backend(name)
    exact, weights = backend.encode(images), backend.identity()

    def encode() -> tuple[Tokens, int]:
        with Casts(backend.network) as casts:
            return backend.encode(images), casts.count

    def half(like: torch.Tensor) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16)

    for module in (backends.da3.backend, backends.vggt):
        monkeypatch.setattr(module, "half_precision_on_gpu", half)
    expected, before = encode()
    monkeypatch.setattr(backends.network, "half_precision_on_gpu", half)
    backend.encode(images)
    found, after = encode()
    assert (before > 20, after) == (True, 0)
    assert all(map(torch.equal, found.patch, expected.patch))
    assert torch.equal(found.camera, expected.camera)
    assert backend.identity() == weights
    monkeypatch.undo()
    torch.testing.assert_close(backend.encode(images).patch, exact.patch, rtol=0.05, atol=0.05)  # rounded weights
    backend.decode(found)  # the heads stay float32


@pytest.mark.parametrize("views", [2, 4])
def test_reference_strategies_keep_the_view_order(make_backend, make_scene, views: int) -> None:
    """Whatever view is the reference, results belong to the views as given; below three views it is the first."""
    images, _ = make_scene(2, views, SIZE)
    first, balanced = (make_backend("da3_tiny", f"reference_view={s}") for s in ("first", "saddle_balanced"))
    a, b = (backend.decode(backend.encode(images)) for backend in (first, balanced))
    if views == 2:
        assert torch.equal(a.depth, b.depth)
    else:
        assert not torch.equal(a.depth, b.depth)
        order = torch.randperm(views, generator=torch.Generator().manual_seed(1))
        shuffled = balanced.decode(balanced.encode(images[:, order]))
        torch.testing.assert_close(shuffled.depth, b.depth[:, order], rtol=1e-4, atol=1e-5)


def test_given_poses_are_used_up_to_world_frame_and_scale(make_backend, make_scene) -> None:
    images, hints = make_scene(1, 3, SIZE)
    backend = make_backend("da3_tiny", "given_poses=true")
    with pytest.raises(ValueError, match="cameras"):
        backend.encode(images)
    poses = hints.cameras.world_to_camera.clone()
    poses[..., :3, 3] *= 20  # beyond the smallest distance that is normalised
    moved = poses @ invert_rigid(relative_to_first(hints.cameras).world_to_camera[:, 1:2])
    moved[..., :3, 3] *= 3
    given = [Cameras(each, hints.cameras.intrinsics, SIZE) for each in (poses, moved, poses.flip(1))]
    results = [backend.decode(backend.encode(images, Hints(cameras=cameras))).depth for cameras in given]
    torch.testing.assert_close(normalize_cameras(given[0]).world_to_camera[:, 0], torch.eye(4)[None])
    torch.testing.assert_close(results[0], results[1], rtol=1e-4, atol=1e-5)
    assert not torch.allclose(results[0], results[2], rtol=1e-4)


def test_chunked_heads_equal_whole_heads(make_backend, make_scene) -> None:
    """In value and in gradient; a chunked head holds less for the way back."""
    images, _ = make_scene(2, 3, SIZE)
    tokens = make_backend("da3_tiny").encode(images)
    depths, gradients, held = [], [], []
    for chunk in ("null", "4", "1"):
        backend = make_backend("da3_tiny", f"head_chunk={chunk}")
        patch = tuple(tap.clone().requires_grad_() for tap in tokens.patch)
        held.append([])
        with torch.autograd.graph.saved_tensors_hooks(lambda t: held[-1].append(t.numel()) or t, lambda t: t):
            depths.append(backend.decode(tokens.with_patch(patch)).depth)
        gradients.append(torch.cat(torch.autograd.grad(depths[-1].square().sum(), patch)))
    for depth, gradient in zip(depths[1:], gradients[1:], strict=True):
        torch.testing.assert_close(depth, depths[0], rtol=1e-5, atol=1e-6)
        # In norm, not element by element: another chunk rounds differently, and a ReLU at zero may then open or close.
        assert float((gradient - gradients[0]).norm() / gradients[0].norm()) < 1e-3
    assert max(map(sum, held[1:])) < 0.2 * sum(held[0])


def test_metric_depth_grows_with_the_focal_length(make_backend, make_scene) -> None:
    images, hints = make_scene(1, 2, SIZE)
    backend = make_backend("da3_metric_large", *TINY_METRIC)
    with pytest.raises(ValueError, match="cameras"):
        backend.encode(images)
    twice = hints.cameras.intrinsics * torch.tensor([2.0, 2, 1])[:, None]
    one = backend.decode(backend.encode(images, hints))
    two = backend.decode(backend.encode(images, Hints(cameras=Cameras(hints.cameras.world_to_camera, twice, SIZE))))
    torch.testing.assert_close(two.depth, 2 * one.depth)
    assert not backend.predicts_cameras
    assert torch.equal(one.cameras.world_to_camera, hints.cameras.world_to_camera)
    assert torch.equal(one.depth_conf, torch.ones_like(one.depth))


def test_nested_scale_ignores_sky_and_doubt() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(2, 2, 20, 20, generator=generator)
    confidence = 1 + torch.rand(2, 2, 20, 20, generator=generator)
    factor = torch.tensor([3.0, 0.5])
    metric = depth * factor[:, None, None, None]
    sky = torch.zeros_like(depth)
    sky[:, :, :4] = 1
    metric[:, :, :4] = 1000
    metric[confidence < 1.45] = 1000  # below the median whatever the sky is
    cameras = Cameras(torch.eye(4).repeat(2, 2, 1, 1), torch.eye(3).repeat(2, 2, 1, 1), (20, 20))
    geometry = Geometry(depth, confidence, cameras, torch.ones(2))
    torch.testing.assert_close(fit_scale(metric, sky, geometry), factor)
    assert torch.equal(fit_scale(metric, torch.ones_like(sky), geometry), torch.ones(2))
    metric[:, :, 5] = 1e-3  # at the camera's lens
    torch.testing.assert_close(fit_scale(metric, sky, geometry), factor)
    assert torch.equal(fit_scale(torch.zeros_like(metric), sky, geometry), torch.ones(2))


@pytest.fixture
def make_nested(make_backend):
    shared = [f"relative.{o}" for o in (*HEADS, "ffn=mlp", "multiview_from=2", "taps=[1,3,5,7]", "depth=8")]
    metric = [f"metric.{option}" for option in TINY_METRIC]
    return lambda *more: make_backend("da3_nested", *shared, *metric, *more)


def test_nested_cannot_be_trained(make_nested) -> None:
    with pytest.raises(InstantiationException, match="cannot be trained, use backend=da3_giant"):
        make_nested("relative.freeze=false")


def test_nested_keeps_the_relative_geometry(make_nested, make_scene) -> None:
    images, _ = make_scene(2, 2, SIZE)
    backend = make_nested()
    tokens = backend.encode(images)
    geometry = backend.decode(tokens)
    expected = backend.relative.decode(backend.relative.encode(images))
    ground = ~tokens.state["sky"]
    assert torch.equal(geometry.depth[ground], expected.depth[ground])
    assert torch.equal(geometry.depth_conf[ground], expected.depth_conf[ground])
    assert backend.is_metric
    assert (geometry.scale > 0).all()
    assert not torch.equal(geometry.scale, torch.ones(2))
    changed = backend.decode(tokens.with_patch(tuple(patch + 0.1 for patch in tokens.patch)))
    assert torch.equal(changed.scale, geometry.scale)


def test_nested_sky_is_far_and_stays_there(make_nested, make_scene) -> None:
    """The metric network says what is sky; the far end is the relative network's, whatever the tokens become."""
    images, _ = make_scene(2, 2, SIZE)
    backend = make_nested()
    decode_raw = backend.metric.decode_raw
    top = slice(0, SIZE[0] // 3)

    def with_sky(tokens):
        depth, sky = decode_raw(tokens)
        sky = torch.zeros_like(sky)
        sky[0, :, top] = 0.5
        return depth, sky

    backend.metric.decode_raw = with_sky
    tokens = backend.encode(images)
    geometry = backend.decode(tokens)
    plain = backend.relative.decode(tokens)
    far = plain.depth[0, :, top.stop :].quantile(0.99)
    torch.testing.assert_close(geometry.depth[0, :, top], far.expand_as(geometry.depth[0, :, top]))
    assert (geometry.depth_conf[0, :, top] == 1).all()
    assert torch.equal(geometry.depth[0, :, top.stop :], plain.depth[0, :, top.stop :])
    assert torch.equal(geometry.depth[1], plain.depth[1])
    patch = tuple((tap + 0.1).requires_grad_() for tap in tokens.patch)
    changed = backend.decode(tokens.with_patch(patch))
    assert torch.equal(changed.depth[0, :, top], geometry.depth[0, :, top])
    changed.depth[0, :, top].sum().backward()
    assert all(not tap.grad.any() for tap in patch)
