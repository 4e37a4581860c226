"""Errors of the readers of files and datasets."""


class FormatError(ValueError):
    """A file violates its format; the message names the file, the place in it, what was expected and a remedy.

    Missing and unreadable files raise the usual ``OSError`` instead, unless a docstring says otherwise.
    """


class DataError(ValueError):
    """A dataset is invalid; the message names the file, the scene and a remedy."""
