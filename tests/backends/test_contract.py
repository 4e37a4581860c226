"""What every backend must keep; ``pytest tests/backends --backend my_pkg.MyBackend`` tests another one."""

import dataclasses

import pytest
import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.geometry.cameras import relative_to_first
from vg2gt.types import Geometry, Hints, Tokens


@pytest.fixture(scope="module")
def scene(backend: Backend, make_scene):
    return make_scene(2, 3, (4 * backend.patch_size, 6 * backend.patch_size))


@pytest.fixture(scope="module")
def tokens(backend: Backend, scene) -> Tokens:
    return backend.encode(*scene)


@pytest.fixture(scope="module")
def geometry(backend: Backend, tokens: Tokens) -> Geometry:
    return backend.decode(tokens)


def pick(scene: tuple[Tensor, Hints], scenes: list[int], views: list[int]) -> tuple[Tensor, Hints]:
    """The same data with some scenes and views, in that order."""
    images, hints = scene
    keys = tuple(hints.scene_key[index] for index in scenes)
    picked = hints.map(lambda tensor: tensor[scenes][:, views])
    return images[scenes][:, views], dataclasses.replace(picked, scene_key=keys)


def assert_same(result: Geometry, expected: Geometry, views: list[int] | None = None) -> None:
    order = views or list(range(expected.depth.shape[1]))
    for name in ("depth", "depth_conf"):
        torch.testing.assert_close(getattr(result, name), getattr(expected, name)[:, order], rtol=1e-4, atol=1e-5)
    poses = [relative_to_first(g.cameras).world_to_camera for g in (result, expected)]
    torch.testing.assert_close(poses[0], poses[1][:, order], rtol=1e-4, atol=1e-4)


def test_shapes_and_values(backend: Backend, scene, tokens: Tokens, geometry: Geometry) -> None:
    batch, views, _, height, width = scene[0].shape
    assert tokens.grid == (height // backend.patch_size, width // backend.patch_size)
    assert tokens.size == (height, width)
    patches = tokens.grid[0] * tokens.grid[1]
    assert [tuple(t.shape) for t in tokens.patch] == [(batch, views, patches, dim) for dim in backend.token_dims]
    assert (tokens.camera.shape[:2], tokens.camera.dim()) == ((batch, views), 3)
    assert geometry.depth.shape == geometry.depth_conf.shape == (batch, views, height, width)
    assert geometry.cameras.world_to_camera.shape == (batch, views, 4, 4)
    assert (geometry.cameras.intrinsics.shape, geometry.cameras.size) == ((batch, views, 3, 3), (height, width))
    assert geometry.scale.shape == (batch,)
    assert geometry.depth.dtype == torch.float32
    assert torch.isfinite(geometry.depth).all()
    assert (geometry.depth >= 0).all()
    assert (geometry.depth_conf > 0).all()
    rotation = geometry.cameras.world_to_camera[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation), rtol=0, atol=1e-4)
    last = geometry.cameras.world_to_camera[..., 3, :]
    assert torch.equal(last, torch.tensor([0.0, 0.0, 0.0, 1.0]).expand_as(last))
    assert (geometry.cameras.intrinsics[..., [0, 1], [0, 1]] > 0).all()
    centre = geometry.cameras.intrinsics[..., :2, 2]  # in pixels
    assert ((centre - torch.tensor([width / 2, height / 2])).abs() < torch.tensor([width / 4, height / 4])).all()


def test_cameras_alone_are_those_of_all(backend: Backend, scene, tokens: Tokens, geometry: Geometry) -> None:
    for cameras in (backend.decode_cameras(tokens), backend.predict_cameras(*scene)):
        assert torch.equal(cameras.world_to_camera, geometry.cameras.world_to_camera)
        assert torch.equal(cameras.intrinsics, geometry.cameras.intrinsics)
        assert cameras.size == geometry.cameras.size


def test_decoding_again_with_known_cameras_gives_the_same_geometry(
    backend: Backend, tokens: Tokens, geometry: Geometry
) -> None:
    again = backend.decode_again(tokens, geometry.cameras)
    for name in ("depth", "depth_conf", "scale"):
        assert torch.equal(getattr(again, name), getattr(geometry, name))


def test_given_poses_keep_their_direction(backend: Backend, scene, geometry: Geometry) -> None:
    """World to camera: the inverse of what is given is not nearer than what is given."""
    if not backend.needs_hints:
        pytest.skip("this backend finds its poses itself")
    found = relative_to_first(geometry.cameras).world_to_camera[..., :3, :3]
    given = relative_to_first(scene[1].cameras).world_to_camera[..., :3, :3]
    assert (found - given).abs().mean() < 0.5 * (found - given.mT).abs().mean()


def test_is_frozen(backend: Backend, tokens: Tokens) -> None:
    assert not any(parameter.requires_grad for parameter in backend.parameters())
    assert not any(tensor.requires_grad for tensor in (*tokens.patch, tokens.camera))


def test_images_of_other_sizes_and_out_of_range_are_refused(backend: Backend, scene, make_scene) -> None:
    with pytest.raises(ValueError, match=r"multiple of the patch size"):
        backend.encode(*make_scene(1, 2, (4 * backend.patch_size + 1, 6 * backend.patch_size)))
    images, hints = scene
    for bad in (images * 255, images - 0.5, images * torch.nan):
        with pytest.raises(ValueError, match=r"in \[0, 1\]"):
            backend.encode(bad, hints)


def test_missing_hints_and_cameras_that_are_no_cameras_are_refused(backend: Backend, scene) -> None:
    if not backend.needs_hints:
        pytest.skip("this backend works from images alone")
    images, hints = scene
    with pytest.raises(ValueError, match="hints"):
        backend.encode(images)
    for part, value in (("world_to_camera", torch.nan), ("intrinsics", torch.inf), ("intrinsics", -1.0)):
        bad = getattr(hints.cameras, part).clone()
        bad[1, 2, 0, 0] = value
        cameras = dataclasses.replace(hints.cameras, **{part: bad})
        with pytest.raises(ValueError, match="scene 1, view 2"):
            backend.encode(images, dataclasses.replace(hints, cameras=cameras))


def test_decoding_again_is_bit_equal_and_cameras_ignore_patches(backend, tokens, geometry) -> None:
    """Everything ``decode`` needs is in the record, moved and detached as one."""
    unchanged = tokens.with_patch(tuple(patch + torch.zeros_like(patch) for patch in tokens.patch))
    copy = dataclasses.replace(tokens.detach()).map(torch.clone)
    for again in (backend.decode(tokens), backend.decode(unchanged), backend.decode(copy)):
        assert torch.equal(again.depth, geometry.depth)
        assert torch.equal(again.depth_conf, geometry.depth_conf)
        assert torch.equal(again.cameras.world_to_camera, geometry.cameras.world_to_camera)
        assert torch.equal(again.cameras.intrinsics, geometry.cameras.intrinsics)
    changed = backend.decode(tokens.with_patch(tuple(patch + 0.1 for patch in tokens.patch)))
    assert torch.equal(changed.cameras.world_to_camera, geometry.cameras.world_to_camera)


def test_gradient_reaches_the_tokens(backend: Backend, tokens: Tokens) -> None:
    patch = tuple(patch.detach().clone().requires_grad_() for patch in tokens.patch)
    depth = backend.decode(tokens.with_patch(patch)).depth
    weight = torch.linspace(0, 1, depth.numel()).view_as(depth)
    gradients = torch.autograd.grad((depth * weight).sum(), patch)
    assert all(gradient.abs().amax((2, 3)).min() > 0 for gradient in gradients)  # in every tap, scene and view
    assert all(parameter.grad is None for parameter in backend.parameters())


def test_gradient_survives_autocast(backend: Backend, tokens: Tokens, geometry: Geometry) -> None:
    with torch.autocast("cpu", torch.bfloat16):
        again = backend.decode(tokens)
    assert again.depth.dtype == torch.float32
    torch.testing.assert_close(again.depth, geometry.depth, rtol=1e-6, atol=0)


def test_order_of_views_and_batch_of_two(backend: Backend, scene, geometry: Geometry) -> None:
    """Permuting the views behind the first one permutes the result; two scenes are two single ones."""
    order = [0, 2, 1]
    assert_same(backend.decode(backend.encode(*pick(scene, [0, 1], order))), geometry, order)
    for index in (0, 1):
        single = backend.decode(backend.encode(*pick(scene, [index], [0, 1, 2])))
        expected = geometry.map(lambda tensor, index=index: tensor[index : index + 1])
        assert_same(single, expected)


@pytest.mark.parametrize("views", [1, 2, 5])
def test_any_number_of_views(backend: Backend, make_scene, views: int) -> None:
    few = make_scene(1, views, (3 * backend.patch_size, 5 * backend.patch_size))
    if views == 1 and backend.name in ("sweep", "itermvs"):
        with pytest.raises(ValueError, match=rf"{backend.name}.*a single view"):
            backend.encode(*few)
        return
    depth = backend.decode(backend.encode(*few)).depth
    assert depth.shape == few[1].depth.shape
    assert torch.isfinite(depth).all()
