"""Procedural rooms from a seed, rendered with exact depth, normals and poses."""

from vg2gt.data.synthetic.source import SyntheticScenes

__all__ = ["SyntheticScenes"]
