"""Errors of the readers of files and datasets."""

from __future__ import annotations

from collections.abc import Collection


class FormatError(ValueError):
    """A file violates its format; the message names the file, the place in it, what was expected and a remedy.

    Missing and unreadable files raise the usual ``OSError`` instead, unless a docstring says otherwise.
    """


class DataError(ValueError):
    """A dataset is invalid; the message names the file, the scene and a remedy."""


def some(names: Collection[str], most: int = 10, separator: str = ", ") -> str:
    """Lists the first ``most`` of some names for a message, and says how many more there are."""
    shown = separator.join(list(names)[:most])
    return shown + (f"{separator.rstrip(' ,')} and {len(names) - most} more" if len(names) > most else "")
