"""The order of file names as people count."""

from __future__ import annotations

import re


def by_number(name: str) -> tuple[list[str | int], str]:
    """Sorting key of a name: runs of digits count by their value, so that ``IMG_9`` comes before ``IMG_10``."""
    parts = re.split(r"(\d+)", name)  # digits are at the odd places
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name
