"""Baseline models on the same frozen backbone, losses and data (paper, Baselines)."""

from vg2gt.baselines.da3_gaussians import DA3Gaussians
from vg2gt.baselines.pixel_aligned import PixelAligned, PixelHead, VoxelMerged
from vg2gt.baselines.pixels import PointCloud

__all__ = ["DA3Gaussians", "PixelAligned", "PixelHead", "PointCloud", "VoxelMerged"]
