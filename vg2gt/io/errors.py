"""The one error of all readers in this folder."""


class FormatError(ValueError):
    """A file is not what its format says; the message names the file, the place in it, what was expected and a remedy.

    A file that is absent or may not be read raises the usual ``OSError`` instead, except where a docstring says so.
    """
