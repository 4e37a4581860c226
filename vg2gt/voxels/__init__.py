"""Multi-scale differentiable voxels: pooling, Point Transformer V3, PointMLP, coarse and fine modules."""

from vg2gt.voxels.coarse import CoarseModule
from vg2gt.voxels.dense_head import DenseHead
from vg2gt.voxels.fine import FineModule
from vg2gt.voxels.pointmlp import PointMLP
from vg2gt.voxels.ptv3 import PTv3

__all__ = ["CoarseModule", "DenseHead", "FineModule", "PTv3", "PointMLP"]
