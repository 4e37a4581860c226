"""From voxels to Gaussians."""

from vg2gt.gaussians.head import GaussianHead

__all__ = ["GaussianHead"]
