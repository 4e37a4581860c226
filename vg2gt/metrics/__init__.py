"""Evaluation metrics: small pure functions."""

from vg2gt.metrics.cameras import camera_metrics, relative_pose_errors
from vg2gt.metrics.depth import depth_metrics, near_depth_edges, normal_metrics
from vg2gt.metrics.images import LPIPS, WeightsNotFoundError, load_lpips, psnr, ssim
from vg2gt.metrics.kinds import pixel_kinds
from vg2gt.metrics.points import cv, point_metrics

__all__ = [
    "LPIPS",
    "WeightsNotFoundError",
    "camera_metrics",
    "cv",
    "depth_metrics",
    "load_lpips",
    "near_depth_edges",
    "normal_metrics",
    "pixel_kinds",
    "point_metrics",
    "psnr",
    "relative_pose_errors",
    "ssim",
]
