"""Scenes at the edge of what can be reconstructed, made from good ones; and a backbone that can be told what to see."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.geometry.cameras import compose, invert_rigid
from vg2gt.types import Batch, Cameras, Geometry

Mutation = Callable[[Batch], Batch]
ZERO_CONFIDENCE = "zero-confidence"
ONE_POINT = "one-point"


def _with_cameras(batch: Batch, poses: Tensor | None = None, intrinsics: Tensor | None = None) -> Batch:
    cameras = batch.cameras
    poses = cameras.world_to_camera if poses is None else poses
    return replace(
        batch, cameras=Cameras(poses, cameras.intrinsics if intrinsics is None else intrinsics, cameras.size)
    )


def _unchanged(batch: Batch) -> Batch:
    return batch


def _no_depth(batch: Batch) -> Batch:
    return replace(batch, depth=torch.zeros_like(batch.depth))


def _one_pixel(batch: Batch) -> Batch:
    depth = torch.zeros_like(batch.depth)
    depth[:, 0, 5, 9] = 2.0
    return replace(batch, depth=depth)


def _few_pixels(batch: Batch) -> Batch:
    """Just enough for the depth terms, all in one view."""
    depth = torch.zeros_like(batch.depth)
    depth[:, 0, :10, :10] = batch.depth[:, 0, :10, :10]
    return replace(batch, depth=depth)


def _negative_depth(batch: Batch) -> Batch:
    return replace(batch, depth=-batch.depth)


def _times(factor: float) -> Mutation:
    """The same scene in another unit."""

    def mutate(batch: Batch) -> Batch:
        poses = batch.cameras.world_to_camera.clone()
        poses[..., :3, 3] *= factor
        return _with_cameras(replace(batch, depth=batch.depth * factor), poses)

    return mutate


def _depth(value: float) -> Mutation:
    """Walls at one depth, cameras where they were."""
    return lambda batch: replace(batch, depth=torch.full_like(batch.depth, value))


def _images(value: float) -> Mutation:
    return lambda batch: replace(batch, images=torch.full_like(batch.images, value))


def _focal(factor: float) -> Mutation:
    def mutate(batch: Batch) -> Batch:
        intrinsics = batch.cameras.intrinsics.clone()
        intrinsics[..., [0, 1], [0, 1]] *= factor
        return _with_cameras(batch, intrinsics=intrinsics)

    return mutate


def _identical_views(batch: Batch) -> Batch:
    def first(tensor: Tensor) -> Tensor:
        return tensor[:, :1].expand_as(tensor).clone()

    cameras = batch.cameras
    batch = _with_cameras(batch, first(cameras.world_to_camera), first(cameras.intrinsics))
    return replace(batch, images=first(batch.images), depth=first(batch.depth))


def _one_view(batch: Batch) -> Batch:
    return batch.views(slice(0, 1))


def _no_target(batch: Batch) -> Batch:
    return batch.context


def _target_looks_away(batch: Batch) -> Batch:
    """All Gaussians lie behind the held-out cameras."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    poses = batch.cameras.world_to_camera.clone()
    poses[:, batch.num_context :] = turn @ poses[:, batch.num_context :]
    return _with_cameras(batch, poses)


def _target_far_away(batch: Batch) -> Batch:
    poses = batch.cameras.world_to_camera.clone()
    poses[:, batch.num_context :, :3, 3] += 1e6
    return _with_cameras(batch, poses)


def _back_to_back(batch: Batch) -> Batch:
    """No view sees what another sees."""
    poses = batch.cameras.world_to_camera.clone()
    poses[:, 1:] = compose(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), poses[:, 1:])
    return _with_cameras(batch, poses)


def _outliers(batch: Batch) -> Batch:
    """Most points near, the others almost too far to be numbered, on both sides."""
    depth = torch.ones_like(batch.depth)
    depth[..., :10, :] = 1900.0
    return _back_to_back(replace(batch, depth=depth))


def _far_from_origin(batch: Batch) -> Batch:
    """A world whose origin lies 1000 km away."""
    shift = torch.eye(4)
    shift[:3, 3] = 1e6
    return _with_cameras(batch, compose(batch.cameras.world_to_camera, invert_rigid(shift)))


def _called(name: str) -> Mutation:
    return lambda batch: replace(batch, scene=(name,) * len(batch.scene))


SCENES: dict[str, Mutation] = {
    "unchanged": _unchanged,
    "no depth": _no_depth,
    "one pixel with depth": _one_pixel,
    "100 pixels with depth": _few_pixels,
    "negative depth": _negative_depth,
    "all points in one place": _called(ONE_POINT),
    "zero confidence": _called(ZERO_CONFIDENCE),
    "black images": _images(0.0),
    "white images": _images(1.0),
    "10 km, all of it": _times(1e4),
    "10 km, depth alone": _depth(1e4),
    "1 mm, all of it": _times(1e-3),
    "1 mm, depth alone": _depth(1e-3),
    "identical views": _identical_views,
    "one view": _one_view,
    "no held-out view": _no_target,
    "tiny focal length": _focal(1e-4),
    "huge focal length": _focal(1e6),
    "held-out view looks away": _target_looks_away,
    "held-out view far away": _target_far_away,
    "views back to back": _back_to_back,
    "far from the origin": _far_from_origin,
    "outliers on both sides": _outliers,
}


def beside(good: Batch, other: Batch) -> Batch:
    """Two scenes in one batch; the other alone where its views differ in number."""
    if good.images.shape != other.images.shape or good.num_context != other.num_context:
        return other
    cameras = Cameras(
        torch.cat((good.cameras.world_to_camera, other.cameras.world_to_camera)),
        torch.cat((good.cameras.intrinsics, other.cameras.intrinsics)),
        good.cameras.size,
    )
    return Batch(
        images=torch.cat((good.images, other.images)),
        depth=torch.cat((good.depth, other.depth)),
        cameras=cameras,
        is_metric=torch.cat((good.is_metric, other.is_metric)),
        frame_ids=torch.cat((good.frame_ids, other.frame_ids)),
        scene=(*good.scene, *other.scene),
        num_context=good.num_context,
    )


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


def random_mutation(rng: np.random.Generator) -> tuple[str, Mutation]:
    """One to four mutations after another, some of them with random strength."""
    names = rng.choice(list(SCENES), size=int(rng.integers(1, 4)), replace=False)
    steps = [SCENES[name] for name in names]
    label = [*map(str, names)]
    extra = int(rng.integers(0, 6))
    strength = float(10.0 ** rng.uniform(-8, 8))
    seed = int(rng.integers(1 << 31))
    if extra < len(_RANDOM):
        name, make = _RANDOM[extra]
        steps.append(make(strength, torch.Generator().manual_seed(seed)))
        label.append(f"{name} {strength:.1e}")

    def mutate(batch: Batch) -> Batch:
        batch = batch.map(Tensor.clone)
        for step in steps:
            batch = step(batch)
        return batch

    return " + ".join(label), mutate


def _noisy_depth(strength: float, generator: torch.Generator) -> Mutation:
    def mutate(batch: Batch) -> Batch:
        noise = torch.randn(batch.depth.shape, generator=generator)
        return replace(batch, depth=batch.depth * (noise * min(strength, 10.0)).exp())

    return mutate


def _holes(strength: float, generator: torch.Generator) -> Mutation:
    def mutate(batch: Batch) -> Batch:
        keep = torch.rand(batch.depth.shape, generator=generator) < min(strength, 0.5)
        return replace(batch, depth=batch.depth * keep)

    return mutate


def _shaken(strength: float, generator: torch.Generator) -> Mutation:
    def mutate(batch: Batch) -> Batch:
        poses = batch.cameras.world_to_camera.clone()
        poses[..., :3, 3] += strength * torch.randn(poses[..., :3, 3].shape, generator=generator)
        return _with_cameras(batch, poses)

    return mutate


_RANDOM: list[tuple[str, Callable[[float, torch.Generator], Mutation]]] = [
    ("noisy depth", _noisy_depth),
    ("holes", _holes),
    ("shaken cameras", _shaken),
    ("unit", lambda strength, _: _times(strength)),
    ("focal length", lambda strength, _: _focal(strength)),
]
