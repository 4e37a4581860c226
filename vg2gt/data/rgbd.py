"""Folders of RGB-D frames with poses: people's own recordings, exported ScanNet scenes, 7-Scenes sequences."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.image_files import read_color, read_depth
from vg2gt.data.rgbd_layouts import Recording, find_recordings
from vg2gt.data.transforms import from_bytes, resize

log = logging.getLogger(__name__)


class RGBDFolder(SceneSource):
    """Recordings with registered colour and depth images and a pose for every frame (layouts: ``rgbd_layouts.py``).

    One recording cannot be split by scenes, so every ``holdout``-th frame is held out: training never sees it and
    evaluation scores it. Give ``scenes`` to split a folder of many recordings by scenes instead.

    Args:
        root: a recording, a folder of recordings (one or two levels deep), or a list of such folders.
        depth_scale: stored depth units a metre: 1000 for millimetres, 5000 for TUM.
        invalid: stored values that mean "no depth".
        holdout: hold out every this many-th frame; None: none.
        scenes: names of the recordings to use; None: all.
        intrinsics: (fx, fy, cx, cy) in pixels of the colour images, where the folder has no intrinsics or wrong ones.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if a folder holds no recording, or one that is incomplete.
    """

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth_scale: float = 1000.0,
        invalid: Sequence[int] = (0, 65535),
        holdout: int | None = 6,
        scenes: Sequence[str] | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> None:
        if not depth_scale > 0:
            raise ValueError(f"depth_scale must be positive (stored units a metre), got {depth_scale}")
        if holdout is not None and holdout < 2:
            raise ValueError(f"holdout must be at least 2 (or null for none), got {holdout}")
        self.depth_scale = float(depth_scale)
        self.invalid = tuple(int(value) for value in invalid)
        self.holdout = holdout
        recordings = find_recordings(_roots(root), tuple(intrinsics) if intrinsics else None)
        self._recordings = _select(recordings, scenes)
        for recording in self._recordings.values():
            log.info("%s", recording)

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the recordings."""
        return tuple(self._recordings)

    def frames(self, scene: str) -> Sequence[int]:
        """Numbers of the frames that have a pose, in order."""
        return self._recordings[scene].frame_ids

    def held_out(self, scene: str) -> Sequence[int]:
        """Every ``holdout``-th frame, from the middle of the first stretch on."""
        return self.frames(scene)[self.holdout // 2 :: self.holdout] if self.holdout else ()

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames at the size of the depth images; colour of another size is resized to it.

        Raises:
            DataError: naming the file and the scene, if an image cannot be read, has another size than the recording's
                first, or holds no valid depth.
        """
        recording = self._recordings[scene]
        rows = [recording.row(frame) for frame in frame_ids]
        depth = torch.stack([self._depth(recording, row) for row in rows])
        size = (depth.shape[-2], depth.shape[-1])
        colors = [read_color(recording.color[row], scene, recording.color_size) for row in rows]
        images = from_bytes(torch.from_numpy(np.stack(colors))).permute(0, 3, 1, 2).contiguous()
        poses = torch.from_numpy(recording.world_to_camera[rows]).float()
        intrinsics = torch.from_numpy(recording.intrinsics).float().expand(len(rows), 3, 3).contiguous()
        if recording.color_size != size:
            images = resize(Frames(images, images[:, 0], poses, intrinsics), size).images
        return Frames(images, depth, poses, intrinsics)

    def _depth(self, recording: Recording, row: int) -> Tensor:
        path = recording.depth[row]
        stored = read_depth(path, recording.name, recording.depth_size)
        valid = ~np.isin(stored, self.invalid)
        if not valid.any():
            raise DataError(
                f"{path} of scene {recording.name} has no valid depth: all values are in "
                f"invalid={list(self.invalid)}; remove the frame or correct data.invalid"
            )
        return torch.from_numpy(np.where(valid, stored / self.depth_scale, 0).astype(np.float32))


def _roots(root: str | Sequence[str] | None) -> list[Path]:
    if not root:
        raise FileNotFoundError("data.root is not set: name the folder of the recording, data=rgbd data.root=FOLDER")
    roots = [Path(path).expanduser() for path in ([root] if isinstance(root, str) else root)]
    for path in roots:
        if not path.is_dir():
            raise FileNotFoundError(
                f"the data folder {path} (seen from {Path.cwd()}) does not exist: set data.root=FOLDER to a folder "
                "with images/ depth/ poses.txt K.txt, or to one of the other layouts in the documentation"
            )
    return roots


def _select(recordings: Sequence[Recording], scenes: Sequence[str] | None) -> dict[str, Recording]:
    found: dict[str, Recording] = {}
    for recording in recordings:
        if recording.name in found:
            raise DataError(
                f"two recordings are called {recording.name}: {found[recording.name].folder} and {recording.folder}; "
                "rename one, or give data.root their common parent folder"
            )
        found[recording.name] = recording
    if scenes is None:
        return found
    unknown = [name for name in scenes if name not in found]
    if unknown:
        raise DataError(f"there is no scene {', '.join(unknown)}; found are: {', '.join(found)}")
    return {name: found[name] for name in scenes}
