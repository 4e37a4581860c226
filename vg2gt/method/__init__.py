"""The paper's method: coarse enhancement, fine voxels and the self-splitting Gaussian head.

Our additions are in :mod:`vg2gt.method.additions`.
"""

from vg2gt.method.coarse import CoarseModule
from vg2gt.method.dense_head import DenseHead
from vg2gt.method.fine import FineModule
from vg2gt.method.gaussian_head import GaussianHead
from vg2gt.method.point_mlp import PointMLP
from vg2gt.method.ptv3 import PTv3

__all__ = ["CoarseModule", "DenseHead", "FineModule", "GaussianHead", "PTv3", "PointMLP"]
