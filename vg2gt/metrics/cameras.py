"""Camera errors that do not depend on the world frame: relative poses of all pairs of views."""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.types import Cameras

_ACCURACIES = (5, 15, 30)
_AREAS = (3, 5, 15, 30)
_STILL = 1e-6  # shorter baselines, relative to the distance from the world's origin, are float32 rounding


def relative_pose_errors(predicted: Cameras, reference: Cameras) -> tuple[Tensor, Tensor]:
    """Errors of the relative pose of every pair of views, in degrees.

    Args:
        predicted: cameras of B scenes with V views.
        reference: the same views, in any world frame and unit.

    Returns:
        Rotation errors and errors of the translation direction, ``[B, V (V - 1) / 2]`` each. The latter are at most
        90, because opposite directions count as equal. They are 0 where the reference does not move, and 90 where only
        the prediction does not.
    """
    first, second = torch.triu_indices(*(predicted.world_to_camera.shape[1],) * 2, offset=1)
    relative, still = [], []
    for cameras in (predicted, reference):
        poses = cameras.world_to_camera.double()
        pairs = poses[:, second] @ invert_rigid(poses[:, first])
        relative.append(pairs)
        # The difference of equal centres far from the origin is float32 rounding, which has a direction.
        distance = torch.maximum(poses[:, first, :3, 3].norm(dim=-1), poses[:, second, :3, 3].norm(dim=-1))
        still.append(pairs[..., :3, 3].norm(dim=-1) <= _STILL * distance)
    difference = relative[0][..., :3, :3].transpose(-1, -2) @ relative[1][..., :3, :3]
    axis = torch.stack([difference[..., i, j] - difference[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
    trace = difference.diagonal(dim1=-2, dim2=-1).sum(-1)
    rotation = torch.atan2(axis.norm(dim=-1), trace - 1).rad2deg()

    t, t_ref = (pose[..., :3, 3] for pose in relative)
    sine = torch.linalg.cross(t, t_ref, dim=-1).norm(dim=-1)
    translation = torch.atan2(sine, (t * t_ref).sum(-1).abs()).rad2deg()
    translation = torch.where(still[0], 90.0, translation)
    return rotation, torch.where(still[1], 0.0, translation)


def camera_metrics(predicted: Cameras, reference: Cameras) -> dict[str, float]:
    """Scores the cameras of one or more scenes over all pairs of views.

    Args:
        predicted: cameras of B scenes with V >= 2 views.
        reference: the same views.

    Returns:
        ``rra_T`` and ``rta_T``: shares of pairs with a rotation or translation error below T = 5, 15, 30 degrees;
        ``auc_T``, T = 3, 5, 15, 30: area under the accuracy curve of the larger of both errors up to T degrees, in
        steps of one degree.
    """
    rotation, translation = relative_pose_errors(predicted, reference)
    results = {f"rra_{t}": float((rotation < t).double().mean()) for t in _ACCURACIES}
    results |= {f"rta_{t}": float((translation < t).double().mean()) for t in _ACCURACIES}
    worse = torch.maximum(rotation, translation).flatten()
    degrees = torch.arange(1, max(_AREAS) + 1, dtype=worse.dtype, device=worse.device)
    return results | {f"auc_{t}": float((worse[:, None] < degrees[:t]).double().mean()) for t in _AREAS}
