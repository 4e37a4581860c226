"""Inputs of a reconstruction: photos, folders, videos and arrays as one list of pictures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from vg2gt.data.base import Frames
from vg2gt.data.sources.masks import FOLDER as MASKS
from vg2gt.data.sources.masks import (
    image_of_mask,
    joined_masks,
    mask_beside,
    mask_folder,
    resized_mask,
    warn_of_unused,
    warn_without_mask,
)
from vg2gt.data.sources.parsing import PHOTO_SUFFIXES
from vg2gt.data.sources.sparse_points import ObservedPoints
from vg2gt.data.transforms import from_bytes, to_bytes
from vg2gt.inputs.damaged import name_left_out, readable
from vg2gt.inputs.distinct import with_unique_names
from vg2gt.inputs.folders import image_files
from vg2gt.inputs.panoramas import FACES, Panorama, find_panoramas, may_be_panorama, show_spheres, whole_pixels
from vg2gt.io.errors import some
from vg2gt.io.image_files import (
    focal_length,
    frame_count,
    image_size,
    is_damaged,
    orientation,
    read_color,
    read_mask,
    read_mask_file,
    same_shape,
)
from vg2gt.io.images import color_image, has_alpha
from vg2gt.io.photogrammetry import is_camera_file
from vg2gt.io.record3d import R3D, is_archive, read_recorded, recorded_files
from vg2gt.io.video import VIDEO_SUFFIXES, VideoFrames, count_frames, require_pyav, sharpest_frames

log = logging.getLogger(__name__)

ImagesLike: TypeAlias = "str | Path | Image.Image | NDArray[Any] | Tensor | Sequence[Any]"

_OF_SEVERAL = (".tif", ".tiff", ".png", ".webp", ".avif")  # files of pages or animations; MPO's others are previews
_ARCHIVES = (".7z", ".gz", ".rar", ".tar", ".tgz", ".zip")
_HOLDS_PICTURES = (*PHOTO_SUFFIXES, R3D)
_VIDEO_FRAMES = 32  # frames taken from a video by default
MOST_FRAMES = 1000  # frames taken from a video at most
_FRAMES_LOOKED_AT = 5  # frames of a video that tell whether it is a panorama
IN_MEMORY = 100  # maximum number of video frames kept in memory; with more, each is decoded on demand
SFM_SOURCE = "structure from motion"  # prefix of the source of cameras found by it
UNKNOWN_LENS = "unknown"  # lens of images that structure from motion has undistorted


@dataclass(frozen=True)
class Picture:
    """One picture, decoded on demand.

    Attributes:
        name: file name without extension.
        size: upright ``(height, width)`` in pixels.
        read: decodes it as one frame, at least about as large as the given ``(height, width)``. Without a known
            camera, the frame has identity pose and intrinsics.
        source: origin of its camera (and depth, if ``has_depth``); empty if it has no camera.
        has_depth: whether its frame has depth.
        point_depths: ``[n]`` z-depth of the sparse points that it sees; None if there are none.
        points: those of them that are not likely outliers; None if there are none.
        focal: focal length in pixels from EXIF; None if unknown.
        path: its file; None if it has no file of its own.
        pose: ``[4, 4]`` float64 given ``world_to_camera``; None if there is none.
        intrinsics: ``[3, 3]`` float64 given intrinsics, at the size of its camera; None if there are none.
        container: the video or panorama that it is a part of; None: none.
        is_metric: whether its camera (and depth) is in metres.
        lens: lens that its file was undistorted from (``undistortion.lens_text``); empty for a pinhole image.
        whole: the picture without the padding of this one; None: it is not padded.
    """

    name: str
    size: tuple[int, int]
    read: Callable[[tuple[int, int]], Frames]
    source: str = ""
    has_depth: bool = False
    point_depths: NDArray[np.float32] | None = None
    points: ObservedPoints | None = None
    focal: float | None = None
    path: Path | None = None
    pose: NDArray[np.float64] | None = None
    intrinsics: NDArray[np.float64] | None = None
    container: Path | None = None
    is_metric: bool = False
    lens: str = ""
    whole: Picture | None = None


def find_pictures(images: ImagesLike, max_images: int | None = None) -> list[Picture]:
    """Lists the pictures of an input, without their cameras.

    Args:
        images: a file, folder or video, a Pillow image, an array ``[H, W, 3]`` or ``[V, H, W, 3]`` (uint8), a tensor
            ``[3, H, W]`` or ``[V, 3, H, W]`` in [0, 1], or a sequence of these, in any mixture.
        max_images: maximum number of pictures, evenly spread; None: all, but 32 frames of a video.
            Videos give the sharpest frame of each interval, at most 1,000.

    Returns:
        The pictures in order, with unique names. Files that are no images are left out, named in a warning.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if there is no picture (the message names where was searched), or none can be read.
    """
    faults: dict[str, str] = {}
    items = [
        item for item in as_items(images) if not isinstance(item, (str, Path)) or image_of_mask(Path(item)) is None
    ]
    chosen = [picture for item in items for picture in _pictures(item, max_images, faults)]
    name_left_out(faults, len(chosen) + len(faults))
    if not chosen:
        raise ValueError("there are no images to reconstruct; give image files, a folder of them, or a video")
    taken = evenly(chosen, max_images)
    photos = [picture.path for picture in taken if picture.path is not None]
    masks = {photo: mask_beside(photo) for photo in photos}
    folders = {mask_folder(place) for photo in photos for place in (photo.parent, photo.parent.parent)}
    known = sorted(str(folder) for folder in folders if folder is not None)
    if known or any(masks.values()):
        lacking = [str(photo) for photo, mask in masks.items() if mask is None]
        warn_without_mask(lacking, len(masks), (known or [MASKS])[0])
        _name_turned([photo for photo, mask in masks.items() if mask is not None])
    else:
        given = {Path(item).expanduser() for item in items if isinstance(item, (str, Path))}
        warn_of_unused({each for each in given if each.is_dir()} | {photo.parent for photo in photos})
    return with_unique_names(taken)


def _name_turned(photos: Sequence[Path]) -> None:
    """Warns about photographs with masks that are turned such that the shape of a mask does not tell its direction."""
    turned = [photo for photo in photos if orientation(photo, "") != 1]
    both = [str(each) for each in turned if same_shape(image_size(each, ""), image_size(each, "", upright=True))]
    if both:
        log.warning(
            "%d photographs are turned or mirrored by their EXIF data, which their masks do not tell; the masks are "
            "taken as those of the upright photographs: %s", len(both), some(both),
        )  # fmt: skip


def check_pictures(paths: Sequence[str]) -> None:
    """Checks that files and folders hold pictures, without decoding any, before weights are downloaded.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if a video needs a package that is not installed.
        ValueError: if there is no picture, or a file is not a picture.
    """
    found = [existing_path(path) for path in paths]
    others = [path for path in found if path.suffix.lower() in VIDEO_SUFFIXES or is_camera_file(path)]
    files = [path for path in found if path.is_file() and path not in others]
    if len(files) == len(found) and all(map(is_damaged, files)):
        find_pictures(files)
    for path in found:
        if path.suffix.lower() in VIDEO_SUFFIXES:
            require_pyav(f"reading {path}")
        elif path.is_dir() and not any(file.suffix.lower() in _HOLDS_PICTURES for file in path.rglob("*")):
            image_files(path)


def count_pictures(paths: Sequence[str], max_images: int | None = None) -> int:
    """Returns about how many pictures files and folders give, without reading any; an archive counts as one."""
    count = 0
    for path in map(existing_path, paths):
        if path.is_dir():
            try:
                count += len(image_files(path))
            except ValueError:  # a recording of another layout
                continue
        else:
            count += _VIDEO_FRAMES if path.suffix.lower() in VIDEO_SUFFIXES else 1
    return count if max_images is None else min(count, max_images)


def as_items(images: ImagesLike) -> list[Any]:
    """Returns the input as a list."""
    return list(images) if isinstance(images, (list, tuple)) else [images]


def check_limit(max_images: int | None) -> None:
    """Raises ValueError if ``max_images`` is below 1."""
    if max_images is not None and max_images < 1:
        raise ValueError(f"max_images must be at least 1, got {max_images}")


def evenly(pictures: list[Picture], limit: int | None) -> list[Picture]:
    """Returns at most ``limit`` of the pictures, evenly spread; None: all. Raises ValueError if it is below 1."""
    check_limit(limit)
    return pictures if limit is None or len(pictures) <= limit else [pictures[i] for i in spread(len(pictures), limit)]


def existing_path(item: str | Path) -> Path:
    """Returns the path of a file or folder with ``~`` expanded.

    Raises:
        FileNotFoundError: if it does not exist.
        ValueError: if it is an archive.
    """
    path = Path(item).expanduser()
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist (working directory: {Path.cwd()})")
    if path.suffix.lower() in _ARCHIVES and path.is_file():
        raise ValueError(f"{path} is an archive: unpack it and give the folder of the images")
    return path


def shrunk(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Reduces an image ``[H, W, 3]`` of at least 4 times ``size`` to no less than about twice ``size``."""
    factor = min(pixels.shape[0] // size[0], pixels.shape[1] // size[1]) // 2
    if factor < 2:
        return pixels
    height, width = pixels.shape[:2]
    image = Image.fromarray(pixels)
    if height % factor or width % factor:  # the last blocks would be incomplete, and the camera would not fit
        size = (round(width / factor), round(height / factor))
        return np.array(image.resize(size, Image.Resampling.HAMMING))
    return np.array(image.reduce(factor))


def frame_of(pixels: NDArray[np.uint8], mask: NDArray[np.float32] | None = None) -> Frames:
    """Returns the frame of one image ``[H, W, 3]`` without camera or depth, with its mask ``[h, w]`` if given."""
    images = from_bytes(torch.from_numpy(np.ascontiguousarray(pixels))).permute(2, 0, 1)[None]
    poses, intrinsics = torch.eye(4)[None], torch.eye(3)[None]
    counts = None if mask is None else torch.from_numpy(resized_mask(mask, (images.shape[-2], images.shape[-1])))[None]
    return Frames(images.contiguous(), torch.zeros_like(images[:, 0]), poses, intrinsics, mask=counts)


def mask_for(path: Path, upright: bool = True, content: bytes | None = None) -> NDArray[np.float32] | None:
    """Returns the pixel weights of a photograph: the product of its alpha and its mask file (:func:`mask_beside`)."""
    parts = [read_mask(path, "", content=content, upright=upright)]
    file = mask_beside(path)
    if content is None and file is not None:
        parts.append(read_mask_file(file, "", path, upright))
    return joined_masks(parts)


def _pictures(item: Any, max_images: int | None, faults: dict[str, str]) -> list[Picture]:
    """Returns the pictures of an item; adds what is wrong with files that cannot be read to ``faults``, by path."""
    if not isinstance(item, (str, Path)):
        return _from_memory(item)
    path = existing_path(item)
    if path.is_dir():
        return _photos(image_files(path, warn=True), faults)
    if is_camera_file(path):
        raise ValueError(f"{path} is a file of cameras, which are not used here: give the folder of its images")
    if is_archive(path):
        files = recorded_files(path, ".jpg")
        if not files:
            raise ValueError(f"{path} holds no images (rgbd/0.jpg and so on): is it a recording of Record3D?")
        return [_photo(file, read_recorded) for file in files.values()]
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _unrolled(_video(path, max_images or _VIDEO_FRAMES), path, max_images)
    return _photos([path], faults)


def _photos(files: Sequence[Path], faults: dict[str, str]) -> list[Picture]:
    """Returns photographs, panoramas as the faces of a cube; what is wrong with others is added to ``faults``."""
    photos = readable(files, _photo, faults)
    several = [file.name for file in photos if file.suffix.lower() in _OF_SEVERAL and frame_count(file) > 1]
    if several:
        log.warning("%d files hold several pictures, of which the first is used: %s", len(several), some(several))
    panoramas = find_panoramas([(file, photo.size) for file, photo in photos.items()])
    if panoramas:
        first = next(iter(panoramas)).name
        log.warning("%d images are 360 degree panoramas, cut into cube faces: %s, ...", len(panoramas), first)
    return [
        picture
        for file, photo in photos.items()
        for picture in (_panorama_faces(photo, file, panoramas[file]) if file in panoramas else [photo])
    ]


def _panorama_faces(photo: Picture, path: Path, panorama: Panorama) -> list[Picture]:
    def pixels() -> NDArray[np.uint8]:
        return whole_pixels(path, path.stat().st_mtime_ns)

    return _faces(photo.name, panorama, path, pixels, lambda: mask_for(path))


def _faces(
    title: str,
    panorama: Panorama,
    container: Path,
    whole: Callable[[], NDArray[np.uint8]],
    mask: Callable[[], NDArray[np.float32] | None],
) -> list[Picture]:
    """Returns the faces of a panorama; they have no file of their own."""

    def face(name: str) -> Picture:
        def read(size: tuple[int, int]) -> Frames:
            return frame_of(shrunk(panorama.cut(whole(), name), size), panorama.cut_mask(mask(), name))

        side = panorama.side
        return Picture(f"{title}-{name}", (side, side), read, focal=side / 2, container=container)

    return [face(name) for name in panorama.faces()]


def _photo(path: Path, content_of: Callable[[Path], bytes | None] = lambda _: None) -> Picture:
    """Returns a photograph; ``content_of`` reads files inside an archive."""

    def read(size: tuple[int, int]) -> Frames:
        content = content_of(path)
        pixels = read_color(path, "", content=content, upright=True, least=size)
        return frame_of(shrunk(pixels, size), mask_for(path, content=content))

    content = content_of(path)
    size = image_size(path, "", upright=True, content=content)
    if content is not None:
        return Picture(path.stem, size, read)
    return Picture(path.stem, size, read, focal=focal_length(path, size), path=path)


def _video(path: Path, limit: int) -> list[Picture]:
    """Returns all frames of a video, or the sharpest of each of ``limit`` intervals."""
    count = count_frames(path)
    if limit > MOST_FRAMES < count:
        log.warning("%s: %d frames are taken of %d, the most of a video", path, MOST_FRAMES, count)
    chosen = sharpest_frames(path, count, min(count, limit, MOST_FRAMES))
    if min(count, limit) > IN_MEMORY:
        names = {number: f"{path.stem}-{number:06d}" for number, _ in chosen}
        frames = VideoFrames(path, names)
        size = frames.read(min(names)).shape[:2]

        def picture(number: int) -> Picture:
            return Picture(names[number], size, lambda wanted: frame_of(shrunk(frames.read(number), wanted)))

        found = [picture(number) for number in names]
    else:
        found = [_in_memory(f"{path.stem}-{number:06d}", pixels()) for number, pixels in chosen]
    return [replace(each, container=path) for each in found]


def _unrolled(frames: list[Picture], path: Path, limit: int | None) -> list[Picture]:
    """Returns the frames of a video, those of a 360 degree camera as at most ``limit`` faces of a cube."""

    def pixels(frame: Picture) -> NDArray[np.uint8]:
        return to_bytes(frame.read(frame.size).images[0]).permute(1, 2, 0).numpy()

    if not frames or not may_be_panorama(frames[0].size):
        return frames
    if not show_spheres([pixels(frame) for frame in evenly(frames, _FRAMES_LOOKED_AT)]):
        return frames
    size = frames[0].size
    log.warning("%s is a 360 degree video; its frames are cut into cube faces", path)
    chosen = evenly(frames, None if limit is None else max(limit // len(FACES), 1))
    return [
        face
        for frame in chosen
        for face in _faces(frame.name, Panorama(size, size), path, lambda frame=frame: pixels(frame), lambda: None)
    ]


def _in_memory(name: str, pixels: NDArray[np.uint8], mask: NDArray[np.float32] | None = None) -> Picture:
    def read(size: tuple[int, int]) -> Frames:
        return frame_of(shrunk(pixels, size), mask)

    return Picture(name, (pixels.shape[0], pixels.shape[1]), read)


def _from_memory(item: Any) -> list[Picture]:
    if isinstance(item, Image.Image):
        upright = ImageOps.exif_transpose(item)
        plane = np.array(upright.convert("RGBA").getchannel("A"), np.float32)
        alpha = (plane / 255).astype(np.float32) if has_alpha(upright) else None
        return [_in_memory("image", np.array(color_image(upright)), alpha)]
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


def spread(count: int, limit: int) -> list[int]:
    """Returns ``limit`` of ``count`` positions, evenly spread, including the first and the last."""
    return [round(i * (count - 1) / max(limit - 1, 1)) for i in range(limit)]
