"""Cameras by structure from motion against known ones: ``python benchmarks/sfm_cameras.py RECORDING [RECORDING ...]``.

Finds the cameras of a recording's images as ``vg2gt reconstruct --poses sfm`` does and compares them with its own: how
many images were placed, errors of position (after the similarity that fits best, as a share of the largest distance of
two cameras) and of relative rotation, of the focal length, and how much of the recording's depth lies in the range that
the sparse points tell. With ``--held-out N`` every N-th image is left out of a reconstruction by the shipped weights
and rendered, once with the recording's cameras and once with those that were found. Needs ``pip install "vg2gt[sfm]"``.
Writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, write_results

from vg2gt.evaluation.tables import print_table
from vg2gt.geometry.alignment import align_points
from vg2gt.geometry.cameras import camera_centers, relative_to_first, scale_translations
from vg2gt.metrics.cameras import relative_pose_errors
from vg2gt.metrics.images import psnr
from vg2gt.profiling import peak_memory_mib
from vg2gt.reconstruction.given_cameras import given_pictures
from vg2gt.reconstruction.inputs import depth_range, load_views, working_size
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import Picture, find_pictures
from vg2gt.reconstruction.sfm import IMAGE_SIDE, find_cameras
from vg2gt.runs.load import load_model
from vg2gt.types import Cameras


def main() -> None:
    """Measures one recording after the other."""
    options = parser(__doc__)
    options.add_argument("recordings", nargs="+", type=Path)
    options.add_argument("--images", type=int, help="take so many, evenly spread")
    options.add_argument("--held-out", type=int, help="render every so many-th image from the others")
    given = options.parse_args()
    rows = [measure(folder, given.images, given.held_out) for folder in given.recordings]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[_cell(row.get(name)) for row in rows] for name in columns[1:]]
    print_table(
        ["", *(row["recording"] for row in rows)],
        [[name, *cell] for name, cell in zip(columns[1:], cells, strict=True)],
        title=f"cameras by structure from motion, {torch.get_num_threads()} threads",
    )
    write_results(given.out, "sfm-cameras", {"machine": machine(), "recordings": rows})


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def measure(folder: Path, limit: int | None, held_out: int | None) -> dict[str, Any]:
    """One recording: what was found, how well, and what it took."""
    known = {picture.name: picture for picture in given_pictures(folder) or []}
    photos = [picture for picture in find_pictures(folder, max_images=limit) if picture.name in known]
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as temporary, Monitor() as monitor:
        found = find_cameras(photos, Path(temporary) / "sfm", monitor)
        seconds = time.process_time() - begin
        cameras, _ = read(found)
        own = [known[picture.name] for picture in found]
        true, depth = read(own)
        scores = (
            {} if held_out is None else {"psnr_found": render(found, held_out), "psnr_known": render(own, held_out)}
        )
    centers = [camera_centers(some) for some in (cameras, true)]
    similarity = align_points(*centers)
    errors = (similarity.apply(centers[0]) - centers[1]).norm(dim=-1)[0]
    rotation, _ = relative_pose_errors(cameras, true)
    kept = min(1.0, IMAGE_SIDE / max(photos[0].size))  # undistortion crops, and changes no focal length
    focal = cameras.intrinsics[0, :, 0, 0] / (kept * true.intrinsics[0, :, 0, 0])
    row = {
        "recording": folder.name,
        "images": len(photos),
        "placed": len(found),
        "position_median": float(errors.median() / torch.cdist(centers[1], centers[1]).max()),
        "position_unit_median": float(errors.median()),
        "rotation_median_deg": float(rotation.median()),
        "rotation_max_deg": float(rotation.max()),
        "focal_ratio": float(focal.median()),
        "processor_seconds": seconds,
        "peak_memory_mib": peak_memory_mib(torch.device("cpu")),
    }
    row |= scores
    near_far = depth_range(found)
    if near_far is not None:
        near, far = (near_far[0] * similarity.scale).tolist()
        row |= {"near": near, "far": far}
        if len(depth):
            row["depth_inside"] = float(((depth >= near) & (depth <= far)).float().mean())
            row["depth_1"], row["depth_99"] = torch.quantile(depth, torch.tensor([0.01, 0.99])).tolist()
    return row


@torch.no_grad()
def render(pictures: list[Picture], every: int) -> float:
    """Mean PSNR [dB] of every so many-th picture, rendered from a reconstruction of the others."""
    loaded = load_model(device="cpu")
    size = working_size([picture.size for picture in pictures], loaded.model.backend.patch_size, "cpu")
    left_out = range(every // 2, len(pictures), every)
    groups = [[p for i, p in enumerate(pictures) if (i in left_out) == held] for held in (False, True)]
    seen, unseen = (load_views(group, size, Monitor()) for group in groups)
    known = [views.hints.cameras for views in (seen, unseen) if views.hints is not None]
    given, wanted = (cameras for cameras in known if cameras is not None)
    prediction = loaded.model.eval()(seen.images[None], seen.hints)
    both = (given.select(slice(0, 1)), wanted)
    poses = torch.cat([cameras.world_to_camera for cameras in both], 1)
    matrices = torch.cat([cameras.intrinsics for cameras in both], 1)
    cameras = scale_translations(relative_to_first(Cameras(poses, matrices, size)), prediction.unit)
    rendered = loaded.renderer(prediction.gaussians, cameras.select(slice(1, None)))
    return float(psnr(rendered.color[0].clamp(0, 1), unseen.images).mean())


def read(pictures: list[Picture]) -> tuple[Cameras, torch.Tensor]:
    """The cameras of pictures, and a sample of their depth, as far as they have any."""
    frames = [picture.read(picture.size) for picture in pictures]
    poses = torch.cat([frame.world_to_camera for frame in frames])[None]
    intrinsics = torch.cat([frame.intrinsics for frame in frames])[None]
    depth = torch.cat([frame.depth.flatten() for frame in frames])
    return Cameras(poses, intrinsics, pictures[0].size), depth[depth > 0][::97]


if __name__ == "__main__":
    main()
