"""VG²GT: feed-forward Gaussian reconstruction on frozen visual foundation models."""

__version__ = "0.1.0"
