"""Warps frames of a scene into one another by depth and poses."""

from torch import Tensor

from vg2gt.data import Frames
from vg2gt.geometry.cameras import project, unproject
from vg2gt.types import Cameras


def camera(frames: Frames, index: int, stride: int = 1) -> Cameras:
    """The camera of a frame of which every ``stride``-th pixel is kept."""
    rows = slice(index, index + 1)
    height, width = frames.depth[0, ::stride, ::stride].shape
    intrinsics = frames.intrinsics[None, rows].clone()
    intrinsics[..., :2, :] /= stride
    return Cameras(frames.world_to_camera[None, rows], intrinsics, (height, width))


def depth_differences(frames: Frames, source: int, target: int, stride: int = 1) -> tuple[Tensor, float]:
    """|depth stored in the target - depth of the source's points there|, and the share of points that both see."""
    depth = frames.depth[source, ::stride, ::stride]
    pixels, z = project(unproject(depth[None, None], camera(frames, source, stride)), camera(frames, target))
    height, width = frames.depth.shape[-2:]
    x, y = pixels[0, 0].round().long().unbind(-1)
    z = z[0, 0]
    inside = (depth > 0) & (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    stored = frames.depth[target][y[inside], x[inside]]
    seen = stored > 0
    return (stored - z[inside])[seen].abs(), float(seen.sum() / (depth > 0).sum())
