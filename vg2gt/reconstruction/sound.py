"""Detection of pictures that are copies of others."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence

from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
from vg2gt.data.transforms import to_bytes
from vg2gt.reconstruction.pictures import HEIC_SUFFIXES, Picture

log = logging.getLogger(__name__)


def without_copies(pictures: Sequence[Picture], decode: bool = False) -> list[Picture]:
    """Returns the pictures without byte-identical copies of earlier files, which are named in a warning.

    Args:
        pictures: in order.
        decode: also compare the pixels of pictures without a file of their own; otherwise these are all kept.
    """
    first: dict[str, str] = {}
    found, copies = [], []
    for picture in pictures:
        whole = picture.path is not None and picture.path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIC_SUFFIXES)
        key = digest(picture) if whole or (decode and picture.path is None) else ""
        if key and key in first:
            copies.append(f"{picture.name} (as {first[key]})")
        else:
            found.append(picture)
            first[key] = picture.name
    if copies:
        log.warning("%d images are copies of others and are left out: %s", len(copies), ", ".join(copies[:10]))
    return found


def digest(picture: Picture) -> str:
    """Returns the hash of a picture's file, or of its pixels if it has none."""
    if picture.path is not None:
        return hashlib.sha256(picture.path.read_bytes()).hexdigest()
    return hashlib.sha256(to_bytes(picture.read(picture.size).images).numpy().tobytes()).hexdigest()
