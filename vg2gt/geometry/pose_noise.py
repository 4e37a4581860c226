"""Noise on camera hints, so that training does not rely on poses more accurate than those of real recordings."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, rigid_motions
from vg2gt.types import Batch, Hints

TURN, SHIFT = 0.004, 0.006  # standard deviations at amount 1, in rad and in median depths
_AMOUNTS = (0.2, 1.5)  # range of the amount, drawn per scene


def with_pose_noise(batch: Batch, share: float) -> Hints:
    """Returns the hints of a batch with pose noise, independent per view, in a ``share`` (0 to 1) of its scenes.

    The same views of a scene always get the same noise, so that a token cache finds them again.
    """
    hints = batch.hints
    if not share or hints.cameras is None:
        return hints
    motions = torch.stack([_motions(batch.single(index), share) for index in range(len(batch.scene))])
    poses = hints.cameras.world_to_camera
    return replace(hints, cameras=replace(hints.cameras, world_to_camera=compose(motions.to(poses), poses)))


def _motions(scene: Batch, share: float) -> Tensor:
    """Returns the random motions ``[V, 4, 4]`` of one scene's views."""
    name = f"{scene.scene[0]}/{scene.frame_ids[0].tolist()}"
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big"))
    views = scene.images.shape[1]
    amount = rng.uniform(*_AMOUNTS) * (rng.random() < share)
    known = scene.depth[scene.depth > 0]
    unit = float(known.median()) if len(known) else 0.0
    turns, shifts = rng.normal(0, TURN * amount, (views, 3)), rng.normal(0, SHIFT * amount * unit, (views, 3))
    return rigid_motions(torch.from_numpy(turns), torch.from_numpy(shifts))
