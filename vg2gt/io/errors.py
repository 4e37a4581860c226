"""Errors of readers: a file that is not what its format says, a dataset that is not what its layout says."""


class FormatError(ValueError):
    """A file is not what its format says; the message names the file, the place in it, what was expected and a remedy.

    A file that is absent or may not be read raises the usual ``OSError`` instead, except where a docstring says so.
    """


class DataError(ValueError):
    """A dataset is not what it should be; the message names the file, the scene and the remedy."""
