"""The frames of a recording as pictures with cameras: of a data set's layout, or found by structure from motion."""

from __future__ import annotations

from vg2gt.data.base import Frames
from vg2gt.data.sources.colmap_model import COLMAP
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.nerfstudio import Nerfstudio
from vg2gt.data.sources.phone import app_of
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.inputs.camera_source import RECORDING
from vg2gt.inputs.folders import is_photo
from vg2gt.inputs.pictures import Picture


def recording_pictures(source: FileSource, with_tests: bool = False) -> list[Picture]:
    """Returns the pictures of a source's only scene, with their cameras and depth, each at its own size.

    Args:
        source: the source.
        with_tests: also return the test frames of Blender's sets.

    Raises:
        ValueError: if the source has several scenes.
    """
    if len(source.scenes) > 1:
        raise ValueError(f"there are {len(source.scenes)} recordings; give one of them: {', '.join(source.scenes)}")
    scene = source.scenes[0]
    source.leave_out_damaged = True
    index = source.scene_index(scene)
    metric = source.is_metric or (isinstance(source, RGBDFolder) and (index.folder / "depth").is_dir())
    name = RECORDING if source.recorded else type(source).__name__
    if isinstance(source, RGBDFolder) and not metric and app_of(index.folder) is None:
        name = "poses"
    kind = f"{name} {index.folder}"

    def picture(frame: int) -> Picture:
        """Returns a frame as a picture that is read on demand."""

        def read(size: tuple[int, int]) -> Frames:
            return source.load_whole(scene, frame, size)

        row = index.row(frame)
        color = index.color[row]
        depths = points = None
        if isinstance(source, COLMAP):
            depths, points = source.point_depths(scene, frame), source.sound_points(scene, frame)
        return Picture(
            color.stem,
            index.own_size(row),
            read,
            kind,
            source.has_depth,
            depths,
            points,
            path=color if color.is_file() and is_photo(color) else None,
            pose=index.world_to_camera[row],
            intrinsics=index.intrinsics[row],
            is_metric=metric,
            lens=index.lens(row),
        )

    tests = set(source.held_out(scene)) if isinstance(source, Nerfstudio) and not with_tests else set()
    return [picture(frame) for frame in source.frames(scene) if frame not in tests]
