"""Procedural scenes as a dataset: made from a seed when first asked for, then read from a cache folder."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.data.base import Frames, SceneSource
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import LOBES, SyntheticScene
from vg2gt.data.transforms import from_bytes
from vg2gt.io.arrays import read_npz
from vg2gt.io.errors import FormatError
from vg2gt.io.files import write_cached

log = logging.getLogger(__name__)


class SyntheticScenes(SceneSource):
    """Furnished rooms with exact depth and poses.

    Scene k of a source has the seed ``first_seed + k`` and the name ``<variant>-<seed>``, so sources whose seed ranges
    do not overlap share no scene.

    Args:
        num_scenes: scenes in this source.
        first_seed: seed of the first scene.
        num_frames: frames on a scene's camera path.
        size: image ``(height, width)``; best the size that is trained on. Upright images are upright photographs: the
            field of view is along the longer side.
        variant: ``room``; ``examples/worlds`` has more, also as a list: of ``[room, room, outdoor]`` seeds take turns.
        highlights: whether surfaces shine, with colours that depend on the view; geometry and textures stay the same.
            ``lobes``: strongly.
        cache_dir: folder for the rendered frames (``~`` is the home folder); None keeps nothing on disk.

    Raises:
        ValueError: if a number is out of range or a variant unknown.
    """

    variants: ClassVar[dict[str, Any]] = {"room": SyntheticRoom}
    """Classes of scenes, like :class:`SyntheticRoom`, by their name."""

    def __init__(
        self,
        num_scenes: int = 64,
        first_seed: int = 0,
        num_frames: int = 16,
        size: Sequence[int] = (112, 224),
        variant: str | Sequence[str] = "room",
        highlights: bool | str = False,
        cache_dir: str | None = None,
    ) -> None:
        if num_scenes < 1 or num_frames < 1 or first_seed < 0:
            raise ValueError(
                "synthetic scenes need num_scenes >= 1, num_frames >= 1 and first_seed >= 0; "
                f"got {num_scenes}, {num_frames} and {first_seed}"
            )
        variants = [variant] if isinstance(variant, str) else list(variant)
        if not variants or not set(variants) <= set(self.variants):
            raise ValueError(
                f"variant must be one of {', '.join(self.variants)}, or a list of them; got {variant!r} (streets, "
                "objects and landmarks: --config-dir examples/worlds/configs data=worlds)"
            )
        if highlights not in (True, False, LOBES):
            raise ValueError(f"highlights must be true, false or {LOBES}; got {highlights!r}")
        self.num_frames = num_frames
        self.size = (int(size[0]), int(size[1]))
        self.highlights = highlights
        self.cache_dir = Path(cache_dir).expanduser() if cache_dir else None
        self._seeds: dict[str, tuple[str, int]] = {}
        for seed in range(first_seed, first_seed + num_scenes):
            kind = variants[seed % len(variants)]
            self._seeds[f"{kind}-{seed:06d}"] = (kind, seed)
        self._names = tuple(self._seeds)

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the scenes."""
        return self._names

    def frames(self, scene: str) -> Sequence[int]:
        """Frame numbers along the camera path."""
        return range(self.num_frames)

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Returns frames of a scene, rendering the scene if the cache does not hold it."""
        arrays = self._read_cache(scene)
        if arrays is None:
            arrays = self._render(scene)
            self._write_cache(scene, arrays)
        rows = list(frame_ids)
        intrinsics = torch.from_numpy(arrays["intrinsics"]).float().expand(len(rows), 3, 3)
        return Frames(
            from_bytes(torch.from_numpy(arrays["images"][rows])).permute(0, 3, 1, 2).contiguous(),
            torch.from_numpy(arrays["depth"][rows]),
            torch.from_numpy(arrays["world_to_camera"][rows]).float(),
            intrinsics.contiguous(),
        )

    def normals(self, scene: str, frame_ids: Sequence[int]) -> torch.Tensor:
        """Renders the exact camera-frame unit normals ``[V, 3, H, W]`` of frames, 0 in the sky; they are not cached."""
        frames = self.scene(scene).render(frame_ids, _threads())
        return torch.from_numpy(np.stack([frame.normal for frame in frames])).permute(0, 3, 1, 2).contiguous()

    def scene(self, scene: str) -> SyntheticScene:
        """Makes a scene, ready to be rendered."""
        kind, seed = self._seeds[scene]
        return self.variants[kind](seed, self.num_frames, self.size, self.highlights)

    @property
    def look(self) -> str:
        """What decides the pixels apart from scene and size, as part of file names."""
        highlights = {True: "-highlights", False: ""}.get(self.highlights, f"-{self.highlights}")  # pyright: ignore
        upright = "-upright" if self.size[0] > self.size[1] else ""  # where the field of view was once horizontal
        return highlights + upright

    def _render(self, scene: str) -> dict[str, NDArray]:
        made = self.scene(scene)
        frames = made.render(range(self.num_frames), _threads())
        return {
            "images": np.stack([frame.image for frame in frames]),
            "depth": np.stack([frame.depth for frame in frames]),
            "world_to_camera": made.world_to_camera,
            "intrinsics": made.intrinsics,
        }

    def cache_file(self, scene: str) -> Path | None:
        """Where a scene's frames are kept; the name holds everything that decides the pixels."""
        if self.cache_dir is None:
            return None
        kind = self._seeds[scene][0]
        size = f"{self.size[0]}x{self.size[1]}x{self.num_frames}"
        folder = f"{kind}s{self.look}-v{self.variants[kind].version}-{size}"
        return self.cache_dir / folder / f"{scene}.npz"

    def _read_cache(self, scene: str) -> dict[str, NDArray] | None:
        """Reads a scene from the cache; None, with a warning, where the file is damaged (its checksums do not fit)."""
        path = self.cache_file(scene)
        if path is None or not path.is_file():
            return None
        try:
            arrays = read_npz(path, ("images", "depth", "world_to_camera", "intrinsics"))
        except (FormatError, KeyError, OSError) as error:
            log.warning("the cached scene %s is damaged (%s) and is made again", path, error)
            return None
        shape = (self.num_frames, *self.size)
        if arrays["images"].shape != (*shape, 3) or arrays["depth"].shape != shape:
            log.warning("the cached scene %s has another shape than %s and is made again", path, shape)
            return None
        return arrays

    def _write_cache(self, scene: str, arrays: dict[str, NDArray]) -> None:
        path = self.cache_file(scene)
        if path is None or self.cache_dir is None:
            return
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
        write_cached(path, buffer.getvalue(), self.cache_dir)


def _threads() -> int:
    """Rendering threads: all cores of this process, or one in a loader's worker, which has siblings."""
    return 1 if torch.utils.data.get_worker_info() is not None else torch.get_num_threads()
