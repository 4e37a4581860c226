"""Cameras of held-out views for training and evaluation; the Gaussians are made from the context views only.

The cameras come from a second, joint pass of the frozen backbone, or from the data. A similarity transform brings them
into the frame of the first pass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.geometry.alignment import align_cameras, fit_depth_scale
from vg2gt.geometry.cameras import relative_to_first, scale_translations
from vg2gt.model import Reconstructor
from vg2gt.types import Batch, Cameras, Prediction


def training_cameras(model: Reconstructor, batch: Batch, prediction: Prediction) -> Cameras:
    """Cameras of all views of the batch: context views as predicted, held-out views from a joint pass."""
    if batch.images.shape[1] == batch.num_context:
        return prediction.geometry.cameras
    seen, held_out = prediction.geometry.cameras, joint_target_cameras(model, batch, prediction)
    return Cameras(
        torch.cat((seen.world_to_camera, held_out.world_to_camera), 1),
        torch.cat((seen.intrinsics, held_out.intrinsics), 1),
        seen.size,
    )


@torch.no_grad()
def joint_target_cameras(model: Reconstructor, batch: Batch, prediction: Prediction) -> Cameras:
    """Predicted cameras of the held-out views (protocol ``novel``), from a joint pass over context and held-out views.

    A similarity transform between the context cameras of both passes brings them into the Gaussians' frame. If the
    context cameras do not move, the scale comes from the depth that both passes decode.
    """
    if not model.backend.predicts_cameras:  # given by the data: no pass is needed
        cameras = scale_translations(relative_to_first(batch.cameras), prediction.unit)
        return cameras.select(slice(batch.num_context, None))
    cameras = model.predict_cameras(batch.images, batch.hints)
    joint = scale_translations(relative_to_first(cameras), prediction.unit)
    context = slice(0, batch.num_context)

    def scale_of_depth() -> Tensor:
        depth = model.run_backbone(batch.images, batch.hints)[1].depth[:, context]
        first = prediction.initial.depth
        return fit_depth_scale(depth * prediction.unit[:, None, None, None], first, first > 0).nan_to_num(1.0)

    similarity = align_cameras(joint.select(context), prediction.geometry.cameras, scale_of_depth)
    return similarity.apply_cameras(joint.select(slice(batch.num_context, None)))


def ground_truth_target_cameras(batch: Batch, prediction: Prediction) -> Cameras:
    """True cameras of the held-out views in the Gaussians' frame (protocol ``gt_pose``), aligned by context cameras."""
    context = batch.context
    depth = prediction.geometry.depth

    def scale_of_depth() -> Tensor:
        return fit_depth_scale(context.depth, depth, context.depth > 0).nan_to_num(1.0)

    similarity = align_cameras(context.cameras, prediction.geometry.cameras, scale_of_depth)
    return similarity.apply_cameras(batch.target.cameras)
