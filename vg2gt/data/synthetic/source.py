"""Dataset of procedural scenes: rendered from a seed on first use, then read from a cache folder."""

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
    """Procedural furnished rooms with exact depth and poses.

    Scene k has the seed ``first_seed + k`` and the name ``<variant>-<seed>``. Sources with disjoint seed ranges
    therefore share no scene.

    Args:
        num_scenes: number of scenes.
        first_seed: seed of the first scene.
        num_frames: number of frames on a scene's camera path.
        size: image ``(height, width)``, preferably the training size. The field of view is measured along the longer
            side, so tall images are like portrait photographs.
        variant: ``room``, or one of the variants of ``examples/worlds``. A list such as ``[room, room, outdoor]`` is
            cycled through by seed.
        highlights: add specular highlights, which make colours view-dependent; geometry and textures do not change.
            ``lobes``: strong highlights.
        cache_dir: folder of the rendered frames (``~`` is expanded); None: no cache on disk.

    Raises:
        ValueError: if a number is out of range or a variant is unknown.
    """

    variants: ClassVar[dict[str, Any]] = {"room": SyntheticRoom}
    """Scene classes by name, with the interface of :class:`SyntheticRoom`."""

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
        """Scene names."""
        return self._names

    def frames(self, scene: str) -> Sequence[int]:
        """Returns the frame numbers along the camera path."""
        return range(self.num_frames)

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Returns frames of a scene; renders the scene if it is not cached."""
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

    def scene(self, scene: str) -> SyntheticScene:
        """Builds a scene, ready for rendering."""
        kind, seed = self._seeds[scene]
        return self.variants[kind](seed, self.num_frames, self.size, self.highlights)

    @property
    def look(self) -> str:
        """Suffix of cache folders for options that change the pixels, apart from scene and size."""
        highlights = {True: "-highlights", False: ""}.get(self.highlights, f"-{self.highlights}")  # pyright: ignore
        upright = "-upright" if self.size[0] > self.size[1] else ""  # older caches have a horizontal field of view
        return highlights + upright

    def _render(self, scene: str) -> dict[str, NDArray]:
        made = self.scene(scene)
        threads = 1 if torch.utils.data.get_worker_info() is not None else torch.get_num_threads()
        frames = made.render(range(self.num_frames), threads)
        return {
            "images": np.stack([frame.image for frame in frames]),
            "depth": np.stack([frame.depth for frame in frames]),
            "world_to_camera": made.world_to_camera,
            "intrinsics": made.intrinsics,
        }

    def cache_file(self, scene: str) -> Path | None:
        """Returns the cache file of a scene; its path encodes everything that determines the pixels."""
        if self.cache_dir is None:
            return None
        kind = self._seeds[scene][0]
        size = f"{self.size[0]}x{self.size[1]}x{self.num_frames}"
        folder = f"{kind}s{self.look}-v{self.variants[kind].version}-{size}"
        return self.cache_dir / folder / f"{scene}.npz"

    def _read_cache(self, scene: str) -> dict[str, NDArray] | None:
        """Reads a scene from the cache; None if it is missing or, with a warning, damaged."""
        path = self.cache_file(scene)
        if path is None or not path.is_file():
            return None
        try:
            return read_npz(path, ("images", "depth", "world_to_camera", "intrinsics"))
        except (FormatError, KeyError, OSError) as error:
            log.warning("the cached scene %s is damaged (%s) and will be rendered again", path, error)
            return None

    def _write_cache(self, scene: str, arrays: dict[str, NDArray]) -> None:
        path = self.cache_file(scene)
        if path is None or self.cache_dir is None:
            return
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
        write_cached(path, buffer.getvalue(), self.cache_dir)
