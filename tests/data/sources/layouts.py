"""What every loader's tests share: the scene they lay out on disk, and the comparison after it was read back.

A layout says how a dataset is written and how it is read. Modules ``layout_*.py`` in this folder each hold some in a
dictionary ``LAYOUTS``; every entry goes through the round trip (``test_round_trip.py``) and through damage
(``test_damage.py``).
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from vg2gt.data import Frames, SyntheticScenes
from vg2gt.data.sources.files import FileSource
from vg2gt.types import Cameras

SIZE = (30, 40)
"""Height and width of the scene's images; small, and no multiple of anything else."""
LEFT_HALF = np.tile(np.where(np.arange(40) < 20, 0, 255).astype(np.uint8), (30, 1))
"""A mask that hides it."""


@dataclass(frozen=True)
class Layout:
    """A dataset's layout on disk."""

    write: Callable[[Path, Frames], object]
    loader: Callable[[str], FileSource]
    image_error: float = 0.0
    depth_quantum: Callable[[torch.Tensor], torch.Tensor] | float | None = 1e-3
    frame_ids: Sequence[int] = range(6)
    moved_world: bool = False

    def read(self, root: Path) -> FileSource:
        return self.loader(str(root))


def all_layouts() -> dict[str, Layout]:
    """Every layout by name."""
    found: dict[str, Layout] = {}
    for path in sorted(Path(__file__).parent.glob("layout_*.py")):
        found |= import_module(f"{__package__}.{path.stem}").LAYOUTS
    return found


@lru_cache
def room(frames: int = 6) -> Frames:
    """Frames of a procedural room, made once and not to be changed."""
    source = SyntheticScenes(1, num_frames=frames, size=SIZE)
    return source.load(source.scenes[0], range(frames))


def camera_to_world(frames: Frames) -> np.ndarray:
    """``[V, 4, 4]`` float64 poses of frames."""
    return np.linalg.inv(frames.world_to_camera.double().numpy())


def cameras_of(frames: Frames) -> Cameras:
    """The same in float64, as one scene of a batch."""
    size = (frames.depth.shape[-2], frames.depth.shape[-1])
    return Cameras(frames.world_to_camera[None].double(), frames.intrinsics[None].double(), size)


def camera_of(frames: Frames) -> list[float]:
    """(fx, fy, cx, cy) of the first frame."""
    matrix = frames.intrinsics[0].double()
    return [float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]


def pixels(frames: Frames) -> np.ndarray:
    """``[V, H, W, 3]`` uint8 images of frames."""
    return (frames.images.permute(0, 2, 3, 1).numpy() * 255 + 0.5).astype(np.uint8)


def millimetres(frames: Frames) -> np.ndarray:
    """``[V, H, W]`` uint16 depth of frames."""
    return (frames.depth.numpy() * 1000 + 0.5).astype(np.uint16)


def save(path: Path, image: np.ndarray) -> None:
    """Writes an image, as JPEG or without loss, and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(image, "JPEG" if path.suffix == ".jpg" else "PNG"))


def encoded(image: np.ndarray, kind: str = "JPEG") -> bytes:
    """A file's content: JPEG of quality 95, or without loss."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, quality=95, subsampling=0)
    return stream.getvalue()


def halve(folder: Path, to: Path) -> None:
    """Images of half the size."""
    for path in sorted(folder.iterdir()):
        with Image.open(path) as image:
            save(to / path.name, np.array(image.reduce(2)))
