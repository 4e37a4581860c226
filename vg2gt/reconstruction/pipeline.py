"""From images to a scene: cameras, forward pass, frame, refinement."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from vg2gt.geometry.cameras import camera_centers
from vg2gt.geometry.geodesy import Place, fit_place
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.inputs.camera_source import CameraSource
from vg2gt.inputs.cameras import Poses, pictures_for
from vg2gt.inputs.folders import is_photo
from vg2gt.inputs.inputs import Views, load_views
from vg2gt.inputs.padding import of_one_shape
from vg2gt.inputs.pictures import ImagesLike, Picture
from vg2gt.io.errors import some
from vg2gt.io.image_files import gps_position
from vg2gt.memory import RECONSTRUCTION, memory_advice, note_sizes
from vg2gt.model import Reconstructor
from vg2gt.monitor import Monitor
from vg2gt.reconstruction.frame import SceneFrame, first_frame
from vg2gt.reconstruction.measured_depth import doubt_of_depth
from vg2gt.reconstruction.order import as_given, in_order, working_order
from vg2gt.reconstruction.policy import Quality, Refinement, check_refinement
from vg2gt.reconstruction.refined import refined_by_policy
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.surroundings import with_surroundings
from vg2gt.reconstruction.trust import odd_views, pixel_trust
from vg2gt.reconstruction.windows import WINDOWS
from vg2gt.reconstruction.windows.run import WindowRun, device_of, window_model
from vg2gt.reconstruction.windows.store import window_size
from vg2gt.rendering import Renderer
from vg2gt.runs.load import LoadedModel
from vg2gt.types import Cameras, Gaussians, Geometry
from vg2gt.uncertainty import Calibration

log = logging.getLogger(__name__)

# Mean of the upward parts of a camera's axes down and ahead: -1 if it is held level or looks straight down, 1 if that
# is mirrored.
_UPSIDE_DOWN = 0.5


@dataclass(frozen=True)
class Pipeline(LoadedModel):
    """A loaded model that reconstructs scenes with the renderer of its run and its calibration."""

    def reconstruct(
        self,
        images: ImagesLike,
        *,
        size: int | tuple[int, int] | None = None,
        quality: Quality = "normal",
        refine: Refinement = None,
        overrides: Sequence[str] = (),
        max_images: int | None = None,
        poses: Poses = "auto",
        window: int | None = None,
        folder: str | Path | None = None,
        monitor: Monitor | None = None,
    ) -> Scene:
        """Turns images into a scene, as ``vg2gt reconstruct`` does.

        Args:
            images: paths, a folder, a video, a recording, or images in memory
                (:func:`vg2gt.inputs.pictures.find_pictures`).
            size: longer side of the images in the model in pixels, or height and width; None: 518, on a CPU
                392 (280 of more than 48 images).
            quality: how long photographs are refined (:func:`vg2gt.reconstruction.policy.refinement_for`).
            refine: whether the scene is then refined on its images; a number of steps refines at the working size
                only. None: up to 100 photographs are refined, RGB-D recordings are not.
            overrides: options of the refinement, ``refine.key=value``.
            max_images: maximum number of images, evenly spread; None: all, 32 of a video.
            poses: where the cameras come from (:func:`vg2gt.inputs.cameras.pictures_for`).
            window: number of images that are processed at a time; 0: all at once; None: 24 if there are more than 100.
            folder: where cameras from structure from motion and finished windows are kept, so that the next call
                reuses them; None: nowhere.
            monitor: shows and times the stages; None: progress bars if the standard error stream is a terminal.

        Returns:
            The scene in the frame of given cameras, else upright. Its Gaussians are on the model's device.

        Raises:
            FileNotFoundError: if a path does not exist.
            ImportError: if cameras must be found and pycolmap is not installed.
            ValueError: if the images cannot be used, or an option is unknown.
            OutOfMemory: if the device's memory is full.
        """
        check_refinement(refine, quality, overrides)
        kept = None if folder is None else Path(folder)
        with ExitStack() as stack:
            if monitor is None:
                monitor = stack.enter_context(Monitor(sys.stderr.isatty(), device_of(self.model)))
            scene = reconstruct_with(
                self.model,
                images,
                max_images=max_images,
                size=size,
                renderer=self.renderer,
                monitor=monitor,
                poses=poses,
                sfm_folder=kept and kept / "sfm",
                window=window,
                window_folder=kept and kept / WINDOWS,
                calibration=self.calibration,
            )
            return refined_by_policy(scene, refine, quality, overrides, monitor)


@torch.no_grad()
def reconstruct_with(
    model: Reconstructor,
    images: ImagesLike,
    *,
    max_images: int | None = None,
    size: int | tuple[int, int] | None = None,
    renderer: Renderer | None = None,
    monitor: Monitor | None = None,
    poses: Poses = "auto",
    sfm_folder: str | Path | None = None,
    window: int | None = None,
    window_folder: str | Path | None = None,
    calibration: Calibration | None = None,
) -> Scene:
    """Reconstructs a scene from images, feed-forward; arguments and errors are those of :meth:`Pipeline.reconstruct`.

    The model is put into eval mode. Without a renderer, solids are rendered, without a calibration, no errors are
    stated. ``sfm_folder`` and ``window_folder`` keep what the next call can use; None: nothing is kept. If the scene is
    made in windows, its images, depth and stated errors are memory-mapped.
    """
    monitor = monitor or Monitor()
    chosen = pictures_for(model, images, poses, max_images=max_images, sfm_folder=sfm_folder, monitor=monitor)
    with memory_advice(RECONSTRUCTION), chosen as pictures:
        pictures, target = of_one_shape(pictures, model.backend.patch_size, device_of(model).type, size)
        note_sizes({f"images of {target[0]}x{target[1]}": len(pictures)})
        if images_at_a_time := window_size(window, len(pictures)):
            # memory-mapped files stay readable after their removal
            with TemporaryDirectory(prefix="vg2gt-windows-", ignore_cleanup_errors=True) as temporary:
                place = Path(window_folder or temporary)
                run = WindowRun(window_model(model.eval()), pictures, target, images_at_a_time, place, monitor)
                geometry, gaussians, unit = run.geometry_and_gaussians()
                error, support = run.trust(geometry, calibration)
                parts = _Parts(geometry, gaussians, unit, run.capture.images, run.capture.mask, error, support)
        else:
            parts = _at_once(model.eval(), load_views(pictures, target, monitor), monitor, calibration)
    scene = _scene(parts, pictures, renderer or Renderer(), model.backend.is_metric)
    if parts.support is not None and (odd := odd_views(parts.support)):
        log.warning(
            "%s contradict the other images: their cameras may be wrong or belong to other images, or they show "
            "something else; correct their cameras or leave them out", some([scene.names[view] for view in odd], 5),
        )  # fmt: skip
    if parts.support is not None and (doubt := doubt_of_depth(pictures, parts.support)):
        log.warning(doubt)
    return with_surroundings(scene, model.visibility is not None).placed()


class _Parts(NamedTuple):
    """What a reconstruction computes; ``error`` and ``support`` as in :class:`Scene`."""

    geometry: Geometry
    gaussians: Gaussians
    unit: Tensor
    images: Tensor
    mask: Tensor | None
    error: Tensor | None = None
    support: Tensor | None = None


def _at_once(model: Reconstructor, views: Views, monitor: Monitor, calibration: Calibration | None) -> _Parts:
    order, device = working_order(views.images), device_of(model)
    ordered, hints = in_order(views, order)
    ordered, hints = ordered[None].to(device), hints.to(device)
    with monitor.stage("reconstruct"), monitor.watching(), half_precision_on_gpu(ordered):
        prediction = model(ordered, hints)
    geometry = as_given(prediction.surface.detach(), order)
    error, support = pixel_trust(prediction, order, views.mask, calibration)
    return _Parts(geometry, prediction.gaussians, prediction.unit, views.images, views.mask, error, support)


def _scene(parts: _Parts, pictures: Sequence[Picture], renderer: Renderer, is_metric: bool) -> Scene:
    """Returns the scene in the cameras' frame, with the transformation to the frame of given cameras, or upright."""
    geometry, gaussians = parts.geometry, parts.gaussians
    if not len(gaussians):
        raise ValueError("the backend found no depth in any image, so there is nothing to reconstruct")
    source = pictures[0].source
    known = [picture.pose for picture in pictures if picture.pose is not None]
    given = np.stack(known) if source and len(known) == len(pictures) else None
    target = "given" if CameraSource.of(source) in (CameraSource.GIVEN, CameraSource.RECORDED) else "upright"
    frame = first_frame(geometry.cameras, float(parts.unit), given, target)
    frame = replace(frame, place=_place(geometry.cameras, frame, pictures))
    metres = frame.scale if pictures[0].is_metric else None
    if frame.world_place is not None and metres is None:
        metres = frame.world_place.scale
    return Scene(
        gaussians=gaussians.detach(),
        cameras=geometry.cameras,
        images=parts.images,
        depth=geometry.depth[0].cpu(),
        depth_conf=geometry.depth_conf[0].cpu(),
        names=tuple(picture.name for picture in pictures),
        renderer=renderer,
        metres_per_unit=float(geometry.scale) if is_metric else metres,
        cameras_from=source,
        frame=frame,
        mask=parts.mask,
        pictures=tuple(pictures),
        error=parts.error,
        support=parts.support,
    )


def _place(cameras: Cameras, frame: SceneFrame, pictures: Sequence[Picture]) -> Place | None:
    """Returns where the source cameras are on the Earth, by the positions that their photographs were taken at."""
    files = [picture.path for picture in pictures]
    found = [None if file is None or not is_photo(file) else gps_position(file) for file in files]
    if not any(found):
        return None
    positions = np.array([(np.nan,) * 3 if each is None else each for each in found])
    if no_altitude := int(np.isfinite(positions[:, 0]).sum() - np.isfinite(positions).all(1).sum()):
        log.warning("the GPS positions of %d photographs have no altitude and are not used", no_altitude)
    centers = camera_centers(cameras)[0].detach().cpu().double().numpy()
    place = fit_place(centers @ frame.to_source[:3, :3].T + frame.to_source[:3, 3], positions)
    if place is None:
        log.warning("the GPS positions of the photographs are too few or too coarse to give the scene a scale")
        return None
    if _upside_down(cameras, frame, place):
        log.warning(
            "the GPS positions of the photographs are not used: by them, the photographs are upside down; are latitude "
            "and longitude swapped, or is east written for west?"
        )
        return None
    return place


def _upside_down(cameras: Cameras, frame: SceneFrame, place: Place) -> bool:
    """Returns whether most source cameras are upside down at a place on the Earth; False if it does not tell up."""
    rotations = cameras.world_to_camera[0, :, :3, :3].detach().cpu().double().numpy()
    axes = rotations @ (frame.to_source[:3, :3] / frame.scale).T
    return place.is_level and float(((axes[:, 1] + axes[:, 2]) @ place.up).mean()) > _UPSIDE_DOWN
