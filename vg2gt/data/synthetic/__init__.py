"""Procedural rooms generated from a seed, with exact depth, normals and poses."""

from vg2gt.data.synthetic.source import SyntheticScenes

__all__ = ["SyntheticScenes"]
