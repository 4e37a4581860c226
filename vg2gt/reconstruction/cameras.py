"""Where the cameras of a reconstruction come from: beside the images, structure from motion, or the backbone."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, get_args

from vg2gt.model import Reconstructor
from vg2gt.reconstruction.given_cameras import LAYOUTS, describe, given_pictures
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import ImagesLike, Picture, find_pictures
from vg2gt.reconstruction.sfm import find_cameras

Poses = Literal["auto", "given", "sfm", "backbone"]


@contextmanager
def pictures_for(
    model: Reconstructor,
    images: ImagesLike,
    poses: Poses = "auto",
    *,
    every: int = 1,
    max_images: int | None = None,
    sfm_folder: Path | None = None,
    monitor: Monitor | None = None,
) -> Iterator[list[Picture]]:
    """The pictures to reconstruct, with cameras if the backbone takes any; they can be read inside the block.

    Args:
        model: whose backbone looks at them.
        images: see :func:`vg2gt.reconstruction.pictures.find_pictures`.
        poses: ``auto``: a backbone that needs cameras gets those beside the images
            (:func:`~vg2gt.reconstruction.given_cameras.given_pictures`), else those of structure from motion
            (:func:`~vg2gt.reconstruction.sfm.find_cameras`); others predict their own. ``given``, ``sfm`` and
            ``backbone`` allow one of these alone.
        every: take every this many-th picture only.
        max_images: take at most so many, evenly spread.
        sfm_folder: where structure from motion keeps its result; None: it is thrown away.
        monitor: told of the stages.

    Yields:
        The pictures.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if structure from motion needs pycolmap and there is none.
        ValueError: if there are no pictures, the cameras asked for are not to be had, or the backbone takes none.
    """
    backend = model.backend
    _check(model, poses)
    if not backend.needs_hints:
        yield find_pictures(images, every, max_images)
        return
    given = None if poses == "sfm" else given_pictures(images, every, max_images, depth=backend.needs_depth)
    if given is not None:
        yield given
        return
    if backend.needs_depth:
        raise ValueError(_no_depth(backend.name, images))
    if poses == "given":
        raise ValueError(
            f"no cameras lie beside {describe(images)}: expected {LAYOUTS}; --poses sfm finds them from the images"
        )
    with tempfile.TemporaryDirectory(prefix="vg2gt-sfm-") as temporary:
        pictures = find_pictures(images, every, max_images)
        yield find_cameras(pictures, sfm_folder or Path(temporary) / "sfm", monitor or Monitor())


def check_depth(backend: str, images: ImagesLike) -> None:
    """Refuses images without depth, before anything is built, for a backend that needs it.

    Args:
        backend: its name, for the message.
        images: what is to be reconstructed.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if the depth is missing.
    """
    if given_pictures(images, depth=True) is None:
        raise ValueError(_no_depth(backend, images))


def _no_depth(backend: str, images: ImagesLike) -> str:
    return (
        f"backend {backend} works from measured depth, and there is none with {describe(images)}: it reconstructs "
        "recordings only (depth/ beside images/, with poses.txt and K.txt). For photographs leave --backend and --ckpt "
        "out (the plane sweep in the package is taken), or take --backend da3_small; a checkpoint fits the backend it "
        "was trained on"
    )


def _check(model: Reconstructor, poses: str) -> None:
    backend = model.backend
    if poses not in get_args(Poses):
        raise ValueError(f"poses is {poses!r}; choose one of {', '.join(get_args(Poses))}")
    if poses == "backbone" and backend.needs_hints:
        raise ValueError(f"backend {backend.name} predicts no cameras; take --poses auto, given or sfm")
    if poses in ("given", "sfm") and not backend.needs_hints:
        raise ValueError(
            f"backend {backend.name} takes no cameras, it predicts its own: leave --poses out, or choose one that "
            "takes them, such as --backend da3_small,given_poses=true"
        )
    if poses == "sfm" and backend.needs_depth:
        raise ValueError(f"backend {backend.name} works from the depth and poses of a recording; leave --poses out")
