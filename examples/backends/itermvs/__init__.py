"""IterMVS (Wang et al., CVPR 2022), a small multi-view stereo network with a recurrent update."""

from examples.backends.itermvs.backend import IterMVSBackend

__all__ = ["IterMVSBackend"]
