"""What may be reconstructed: photographs, folders, videos, posed recordings, arrays; one list of pictures of it all."""

from __future__ import annotations

import importlib.util
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from vg2gt.data.base import Frames
from vg2gt.data.sources.colmap_model import COLMAP, model_folder_of
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.image_folder import by_number
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.data.sources.parsing import IMAGE_SUFFIXES
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.transforms import from_bytes
from vg2gt.io.image_files import image_size, read_color
from vg2gt.io.images import color_image
from vg2gt.io.nerfstudio import read_transforms
from vg2gt.io.video import VIDEO_SUFFIXES, count_frames, read_video

ImagesLike: TypeAlias = "str | Path | Image.Image | NDArray[Any] | Tensor | Sequence[Any]"

HEIC_SUFFIXES = (".heic", ".heif")
VIDEO_FRAMES = 32  # taken from a video when nobody says how many
_IMAGE_FOLDERS = ("images", "color", "rgb")
_TRANSFORMS = "transforms.json"


@dataclass(frozen=True)
class Picture:
    """One picture, decoded when it is asked for.

    Attributes:
        name: of its file without the ending.
        size: upright ``(height, width)`` in pixels.
        read: decodes it as one frame, at least about as large as the ``(height, width)`` given; pictures without known
            cameras have the identity and a guessed focal length.
        source: where its camera (and depth, where ``has_depth``) comes from; empty where there is none.
        has_depth: whether its frame has depth.
    """

    name: str
    size: tuple[int, int]
    read: Callable[[tuple[int, int]], Frames]
    source: str = ""
    has_depth: bool = False


def find_pictures(
    images: ImagesLike, every: int = 1, max_images: int | None = None, posed: bool = False
) -> list[Picture]:
    """Lists the pictures of whatever somebody wants reconstructed.

    Args:
        images: a file, folder or video, a Pillow image, an array ``[H, W, 3]`` or ``[V, H, W, 3]`` (uint8), a tensor
            ``[3, H, W]`` or ``[V, 3, H, W]`` in [0, 1], or a sequence of these, in any mixture.
        every: take every this many-th picture (of videos: frame) only.
        max_images: take at most so many, evenly spread; None: all, of a video 32 frames unless ``every`` is given.
        posed: cameras are needed: folders are read as recordings with known cameras (RGB-D folders,
            ``transforms.json``, COLMAP models), depth too where they have it.

    Returns:
        The pictures in order, their names unique.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if there is no picture, naming what was looked at, or a file cannot be read.
    """
    if every < 1 or (max_images is not None and max_images < 1):
        raise ValueError(f"every and max_images must be at least 1, got {every} and {max_images}")
    items = list(images) if isinstance(images, (list, tuple)) else [images]
    chosen: list[Picture] = []
    stills = 0
    for item in items:
        found = _posed_pictures(item) if posed else _pictures(item, every, max_images)
        if not _is_video(item):  # of a video every so many-th frame was decoded
            stills += len(found)
            found = [picture for i, picture in enumerate(found, stills - len(found)) if i % every == 0]
        chosen += found
    if not chosen:
        raise ValueError("there are no images to reconstruct; give image files, a folder of them, or a video")
    if max_images is not None and len(chosen) > max_images:
        chosen = [chosen[i] for i in spread(len(chosen), max_images)]
    return _with_unique_names(chosen)


def existing_path(item: str | Path) -> Path:
    """The path of a file or folder, its ``~`` expanded.

    Raises:
        FileNotFoundError: if it does not exist.
    """
    path = Path(item).expanduser()
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist (seen from {Path.cwd()})")
    return path


def shrunk(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Averages blocks of pixels of an image ``[H, W, 3]`` that is more than twice as large as ``size`` both ways."""
    factor = min(pixels.shape[0] // size[0], pixels.shape[1] // size[1]) // 2
    return pixels if factor < 2 else np.array(Image.fromarray(pixels).reduce(factor))


def frame_of(pixels: NDArray[np.uint8]) -> Frames:
    """Frame of one image ``[H, W, 3]`` of which nothing else is known."""
    images = from_bytes(torch.from_numpy(np.ascontiguousarray(pixels))).permute(2, 0, 1)[None]
    return Frames(images.contiguous(), torch.zeros_like(images[:, 0]), torch.eye(4)[None], torch.eye(3)[None])


def _pictures(item: Any, every: int, max_images: int | None) -> list[Picture]:
    if not isinstance(item, (str, Path)):
        return _from_memory(item)
    path = existing_path(item)
    if path.is_dir():
        return [_photo(file) for file in _image_files(path)]
    return _video(path, every, max_images) if _is_video(path) else [_photo(path)]


def _image_files(folder: Path) -> list[Path]:
    """Images of a folder or, where it has none, of its folder of images; in the order of the numbers in their names."""
    suffixes = (*IMAGE_SUFFIXES, *HEIC_SUFFIXES)
    for place in (folder, *(folder / name for name in _IMAGE_FOLDERS)):
        inside = sorted(place.iterdir(), key=by_number) if place.is_dir() else []
        files = [file for file in inside if file.suffix.lower() in suffixes and not file.name.startswith(".")]
        if files:
            return files
    videos = sorted(file.name for file in folder.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
    hint = f"; it has videos, name one: {folder / videos[0]}" if videos else ""
    raise ValueError(f"no images in {folder} (looked for {', '.join(suffixes)}, there and in images/){hint}")


def _photo(path: Path) -> Picture:
    if path.suffix.lower() in HEIC_SUFFIXES:
        _open_heic(path)
    place = path.parent.name or "."

    def read(size: tuple[int, int]) -> Frames:
        return frame_of(shrunk(read_color(path, place, upright=True), size))

    return Picture(path.stem, image_size(path, place, upright=True), read)


def _open_heic(path: Path) -> None:
    """Lets Pillow read HEIC files, for which it needs help."""
    if importlib.util.find_spec("pillow_heif") is None:
        raise ValueError(
            f"{path} is HEIC, which Pillow cannot read alone: pip install pillow-heif, or save the photographs as JPEG"
        )
    from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports]

    register_heif_opener()


def _is_video(item: Any) -> bool:
    return isinstance(item, (str, Path)) and Path(item).suffix.lower() in VIDEO_SUFFIXES


def _video(path: Path, every: int, max_images: int | None) -> list[Picture]:
    limit = max_images or (VIDEO_FRAMES if every == 1 else None)
    if limit is not None:
        every = max(every, math.ceil(count_frames(path) / limit))
    return [_in_memory(f"{path.stem}-{number:06d}", pixels) for number, pixels in read_video(path, every)]


def _in_memory(name: str, pixels: NDArray[np.uint8]) -> Picture:
    def read(size: tuple[int, int]) -> Frames:
        return frame_of(shrunk(pixels, size))

    return Picture(name, (pixels.shape[0], pixels.shape[1]), read)


def _from_memory(item: Any) -> list[Picture]:
    if isinstance(item, Image.Image):
        return [_in_memory("image", np.array(color_image(ImageOps.exif_transpose(item))))]
    pixels = item.detach().cpu().movedim(-3, -1).numpy() if isinstance(item, Tensor) else np.asarray(item)
    if pixels.ndim not in (3, 4) or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise ValueError(
            f"an image must be a path, a Pillow image, a uint8 array [H, W, 3] or a tensor [3, H, W] in [0, 1], got "
            f"{type(item).__name__} of shape {list(getattr(item, 'shape', ()))}"
        )
    if pixels.dtype.kind == "f":
        if not (pixels.min() >= 0 and pixels.max() <= 1):
            raise ValueError(f"values of an image must be in [0, 1], got {pixels.min():.4g} to {pixels.max():.4g}")
        pixels = (pixels * 255 + 0.5).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise ValueError(f"an array's values must be uint8, or floats in [0, 1], got {pixels.dtype}")
    return [_in_memory("image", image) for image in (pixels[None] if pixels.ndim == 3 else pixels)]


def _posed_pictures(item: Any) -> list[Picture]:
    path = existing_path(item) if isinstance(item, (str, Path)) else None
    source = _source(path) if path is not None and path.is_dir() else None
    if source is None:
        raise ValueError(
            f"this backend needs known cameras, and {path or type(item).__name__} has none. Give a recording's folder "
            f"(depth images with poses, {_TRANSFORMS}, or a COLMAP model), or take a backend that works from images "
            "alone, such as da3_small or vggt_1b"
        )
    if len(source.scenes) > 1:
        raise ValueError(f"{path} holds {len(source.scenes)} recordings; give one of them: {', '.join(source.scenes)}")
    scene = source.scenes[0]
    index = source.scene_index(scene)
    frames = source.frames(scene)
    kind = f"{type(source).__name__} {index.folder}"

    def reader(frame: int) -> Callable[[tuple[int, int]], Frames]:
        return lambda _: source.load(scene, [frame])

    return [
        Picture(index.color[index.row(frame)].stem, index.size, reader(frame), kind, source.has_depth)
        for frame in frames
    ]


def _source(folder: Path) -> FileSource | None:
    """The recording that a folder holds, with depth where it has any; None for mere photographs."""
    if (folder / _TRANSFORMS).is_file():
        with_depth = any(frame.depth_file_path for frame in read_transforms(folder / _TRANSFORMS).frames)
        return Nerfstudio(str(folder), depth=with_depth)
    if model_folder_of(folder) is not None:
        return COLMAP(str(folder))
    if (folder / "depth").is_dir() or any(folder.glob("frame-*.color.*")):
        return RGBDFolder(str(folder), holdout=None)
    return None


def spread(count: int, limit: int) -> Iterable[int]:
    """``limit`` of ``count`` positions, evenly spread, the first and the last among them."""
    return [round(i * (count - 1) / max(limit - 1, 1)) for i in range(limit)]


def _with_unique_names(pictures: Sequence[Picture]) -> list[Picture]:
    """Numbers pictures of equal names."""
    counts = Counter(picture.name for picture in pictures)
    taken, result = {name for name, count in counts.items() if count == 1}, []
    number: Counter[str] = Counter()
    for picture in pictures:
        name = picture.name
        while counts[picture.name] > 1 and (name == picture.name or name in taken):
            name = f"{picture.name}-{number[picture.name]:03d}"
            number[picture.name] += 1
        taken.add(name)
        result.append(replace(picture, name=name))
    return result
