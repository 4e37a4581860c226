"""Scenes at the edge of what can be reconstructed, made from good ones; and a backbone that can be told what to see."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.geometry.cameras import compose, invert_rigid
from vg2gt.types import Batch, Cameras, Geometry

Mutation = Callable[[Batch], Batch]
ZERO_CONFIDENCE, ONE_POINT = "zero-confidence", "one-point"
TURN = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))


def _posed(change: Callable[[Tensor, int], Any]) -> Mutation:
    """Changes a copy of the poses ``[B, V, 4, 4]`` in place, given the number of context views."""

    def mutate(batch: Batch) -> Batch:
        poses = batch.cameras.world_to_camera.clone()
        change(poses, batch.num_context)
        return replace(batch, cameras=replace(batch.cameras, world_to_camera=poses))

    return mutate


def _focal(factor: float) -> Mutation:
    def mutate(batch: Batch) -> Batch:
        intrinsics = batch.cameras.intrinsics.clone()
        intrinsics[..., [0, 1], [0, 1]] *= factor
        return replace(batch, cameras=replace(batch.cameras, intrinsics=intrinsics))

    return mutate


def _depth(change: Callable[[Tensor], Tensor]) -> Mutation:
    return lambda batch: replace(batch, depth=change(batch.depth))


def _only(*place: slice | int) -> Mutation:
    """Depth in one place of the first view only."""

    def change(depth: Tensor) -> Tensor:
        kept = torch.zeros_like(depth)
        kept[:, 0, place[0], place[1]] = depth[:, 0, place[0], place[1]]
        return kept

    return _depth(change)


def _images(value: float) -> Mutation:
    return lambda batch: replace(batch, images=torch.full_like(batch.images, value))


def _times(factor: float) -> Mutation:
    """The same scene in another unit."""
    scaled = _posed(lambda poses, _: poses[..., :3, 3].mul_(factor))
    return lambda batch: scaled(replace(batch, depth=batch.depth * factor))


def _identical_views(batch: Batch) -> Batch:
    def first(tensor: Tensor) -> Tensor:
        return tensor[:, :1].expand_as(tensor).clone()

    return replace(batch, cameras=batch.cameras.map(first), images=first(batch.images), depth=first(batch.depth))


def _back_to_back(poses: Tensor, _: int) -> None:
    poses[:, 1:] = compose(TURN, poses[:, 1:])


def _away(poses: Tensor, context: int) -> None:
    poses[:, context:] = TURN @ poses[:, context:]


def _far_from_origin(poses: Tensor, _: int) -> None:
    shift = torch.eye(4)
    shift[:3, 3] = 1e6
    poses.copy_(compose(poses, invert_rigid(shift)))


def _outliers(batch: Batch) -> Batch:
    """Most points near, the others almost too far to be numbered, on both sides."""
    depth = torch.ones_like(batch.depth)
    depth[..., :10, :] = 1900.0
    return _posed(_back_to_back)(replace(batch, depth=depth))


def _called(name: str) -> Mutation:
    return lambda batch: replace(batch, scene=(name,) * len(batch.scene))


SCENES: dict[str, Mutation] = {
    "unchanged": lambda batch: batch,
    "no depth": _depth(torch.zeros_like),
    "one pixel with depth": _only(5, 9),
    "100 pixels with depth": _only(slice(0, 10), slice(0, 10)),  # just enough for the depth terms
    "negative depth": _depth(torch.neg),
    "all points in one place": _called(ONE_POINT),
    "zero confidence": _called(ZERO_CONFIDENCE),
    "black images": _images(0.0),
    "white images": _images(1.0),
    "10 km, all of it": _times(1e4),
    "10 km, depth alone": _depth(lambda depth: torch.full_like(depth, 1e4)),
    "1 mm, all of it": _times(1e-3),
    "1 mm, depth alone": _depth(lambda depth: torch.full_like(depth, 1e-3)),
    "identical views": _identical_views,
    "one view": lambda batch: batch.views(slice(0, 1)),
    "no held-out view": lambda batch: batch.context,
    "tiny focal length": _focal(1e-4),
    "huge focal length": _focal(1e6),
    "held-out view looks away": _posed(_away),
    "held-out view far away": _posed(lambda poses, context: poses[:, context:, :3, 3].add_(1e6)),
    "views back to back": _posed(_back_to_back),
    "far from the origin": _posed(_far_from_origin),
    "outliers on both sides": _outliers,
}


def beside(good: Batch, other: Batch) -> Batch:
    """Two scenes in one batch; the other alone where its views differ in number."""
    if good.images.shape != other.images.shape or good.num_context != other.num_context:
        return other

    def both(name: str, one: Any = good, two: Any = other) -> Tensor:
        return torch.cat((getattr(one, name), getattr(two, name)))

    both_cameras = [both(name, good.cameras, other.cameras) for name in ("world_to_camera", "intrinsics")]
    cameras = Cameras(both_cameras[0], both_cameras[1], good.cameras.size)
    tensors = {name: both(name) for name in ("images", "depth", "frame_ids")}
    return Batch(**tensors, cameras=cameras, scene=(*good.scene, *other.scene), num_context=good.num_context)


def obey_names(backend: Backend, monkeypatch: Any) -> None:
    """Makes a backbone see what the scene's name says: :data:`ZERO_CONFIDENCE` or :data:`ONE_POINT`."""
    encode, decode = backend.encode, backend.decode

    def told(images: Tensor, hints: Any = None) -> Any:
        tokens = encode(images, hints)
        return replace(tokens, state={**tokens.state, "name": hints.scene_key[0]})

    def seen(tokens: Any) -> Geometry:
        geometry = decode(tokens)
        if tokens.state["name"] == ZERO_CONFIDENCE:
            return replace(geometry, depth_conf=torch.zeros_like(geometry.depth_conf))
        if tokens.state["name"] == ONE_POINT:
            cameras = geometry.cameras
            intrinsics = cameras.intrinsics.clone()
            intrinsics[..., [0, 1], [0, 1]] = 1e12
            poses = torch.eye(4).expand_as(cameras.world_to_camera)
            depth = torch.ones_like(geometry.depth) + 0 * geometry.depth
            return replace(geometry, depth=depth, cameras=Cameras(poses, intrinsics, cameras.size))
        return geometry

    monkeypatch.setattr(backend, "encode", told)
    monkeypatch.setattr(backend, "decode", seen)
