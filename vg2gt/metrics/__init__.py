"""Evaluation metrics: small pure functions."""

from vg2gt.metrics.cameras import camera_metrics, relative_pose_errors
from vg2gt.metrics.depth import depth_metrics
from vg2gt.metrics.images import psnr, ssim
from vg2gt.metrics.normals import normal_metrics
from vg2gt.metrics.uniformity import cv

__all__ = ["camera_metrics", "cv", "depth_metrics", "normal_metrics", "psnr", "relative_pose_errors", "ssim"]
