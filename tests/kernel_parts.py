"""Parts of kernels as kernels call them: from Python they would be interpreted."""

from collections.abc import Callable
from typing import Any

import numba


def compiled_part(part: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that does nothing but call the part."""
    return numba.njit(lambda *arguments: part(*arguments))
