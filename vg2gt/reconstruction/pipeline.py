"""From images to a scene in one call."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.memory import RECONSTRUCTION, memory_advice, note_sizes
from vg2gt.method.additions.far_shell import far_shell
from vg2gt.model import Reconstructor
from vg2gt.reconstruction.cameras import Poses, pictures_for
from vg2gt.reconstruction.frame import FrameName, check_frame, first_frame
from vg2gt.reconstruction.inputs import Views, load_views, source_of, working_size
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.order import as_given, in_order, working_order
from vg2gt.reconstruction.pictures import SFM_SOURCE, ImagesLike, spread
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.trust import pixel_trust
from vg2gt.reconstruction.windows.capture import AUTOMATIC, window_size
from vg2gt.reconstruction.windows.run import WindowRun, window_model
from vg2gt.reconstruction.windows.sets import Anchor
from vg2gt.rendering import Renderer
from vg2gt.runs.load import load_model
from vg2gt.types import Gaussians, Geometry, Prediction
from vg2gt.uncertainty import Calibration


def reconstruct(
    images: ImagesLike,
    ckpt: str | Path | None = None,
    backend: str | None = None,
    *,
    every: int = 1,
    max_images: int | None = None,
    size: int | tuple[int, int] | None = None,
    window: int | None = None,
    device: str = "auto",
) -> Scene:
    """Builds a model and reconstructs a scene: :func:`load_model`, then :func:`reconstruct_with`."""
    ready = load_model(ckpt, backend, device=device)
    choice = {"every": every, "max_images": max_images, "size": size, "window": window}
    return reconstruct_with(ready.model, images, renderer=ready.renderer, calibration=ready.calibration, **choice)


@torch.no_grad()
def reconstruct_with(
    model: Reconstructor,
    images: ImagesLike,
    *,
    every: int = 1,
    max_images: int | None = None,
    size: int | tuple[int, int] | None = None,
    renderer: Renderer | None = None,
    monitor: Monitor | None = None,
    poses: Poses = "auto",
    sfm_folder: str | Path | None = None,
    frame: FrameName = "auto",
    skip_damaged: bool = False,
    window: int | None = None,
    window_folder: str | Path | None = None,
    keep_windows: bool = False,
    anchor: Anchor | None = None,
    calibration: Calibration | None = None,
) -> Scene:
    """Reconstructs a scene from any number of images.

    Args:
        model: the model; it is put into eval mode.
        images: see :func:`vg2gt.reconstruction.pictures.find_pictures`.
        every: take only every N-th image.
        max_images: maximum number of images, evenly spread.
        size: see :func:`vg2gt.reconstruction.inputs.working_size`.
        renderer: renderer of the scene; None: solids, with the default options.
        monitor: shows and times the stages.
        poses: source of the cameras, see :func:`vg2gt.reconstruction.cameras.pictures_for`.
        sfm_folder: folder where cameras found by structure from motion are kept and reused; None: they are not kept.
        frame: the scene's frame and unit (:class:`vg2gt.reconstruction.frame.SceneFrame`): ``given`` cameras',
            ``first`` camera's, ``upright``, or ``auto``.
        skip_damaged: skip images that cannot be read, with a warning; otherwise they are an error.
        window: process this many images and their neighbours at a time, which bounds memory
            (:mod:`vg2gt.reconstruction.windows`); 0: all at once; None: 24 if there are more than 100, else all.
        window_folder: folder for finished windows, from which an interrupted reconstruction resumes; None: a temporary
            one.
        keep_windows: always process in windows, because their voxels are kept.
        anchor: anchor of the scene to add the images to (:mod:`vg2gt.reconstruction.windows.sets`).
        calibration: calibration of the model, from which errors are stated; None, or in windows: no stated errors.

    Returns:
        The scene in the requested frame; its Gaussians stay on the model's device. For a scene made in windows, images
        and depth are memory-mapped.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if cameras must be found and pycolmap is not installed.
        ValueError: if there are no images, one cannot be read, or they lack what the backend needs.
        OutOfMemory: if the device's memory is full.
    """
    check_frame(frame)
    monitor = monitor or Monitor()
    device = next((parameter.device for parameter in model.parameters()), torch.device("cpu"))
    chosen = pictures_for(
        model,
        images,
        poses,
        every=every,
        max_images=max_images,
        sfm_folder=None if sfm_folder is None else Path(sfm_folder),
        monitor=monitor,
        skip_damaged=skip_damaged,
    )
    with memory_advice(RECONSTRUCTION), chosen as pictures:
        sizes = [picture.size for picture in pictures]
        target = anchor.size if anchor else working_size(sizes, model.backend.patch_size, device.type, size)
        note_sizes({f"images of {target[0]}x{target[1]}": len(pictures)})
        size_of_windows, to_source = window_size(window, len(pictures), keep_windows or anchor is not None), None
        error, support = None, None
        if size_of_windows:
            with _folder(window_folder) as kept:
                run = WindowRun(window_model(model.eval()), pictures, target, size_of_windows, kept, monitor, anchor)
                geometry, gaussians, unit = run.geometry_and_gaussians()
                views = run.views()
                to_source = run.anchor.to_source if run.anchor and source_of(pictures) else None
        else:
            views = load_views(pictures, target, monitor)
            order = working_order(views.images)
            prediction = _forward(model.eval(), views, order, device, monitor)
            geometry, gaussians = as_given(prediction.surface.detach(), order), prediction.gaussians
            unit = prediction.unit
            error, support = pixel_trust(prediction, order, views.mask, calibration)
    scene = _scene(geometry, gaussians, float(unit), views, renderer or Renderer(), model.backend.is_metric, frame)
    scene = replace(scene, error=error, support=support)
    if to_source is not None and scene.frame is not None:  # exactly the same for all image sets
        scene = replace(scene, frame=replace(scene.frame, to_source=to_source))
    scene = scene if model.visibility is None or anchor else with_far_shell(scene)
    return scene.placed()


def _forward(
    model: Reconstructor, views: Views, order: Sequence[int], device: torch.device, monitor: Monitor
) -> Prediction:
    ordered, hints = in_order(views, order)
    images, hints = ordered[None].to(device), hints.to(device)
    with monitor.stage("reconstruct"), monitor.watching(), half_precision_on_gpu(images):
        return model(images, hints)


@contextmanager
def _folder(given: str | Path | None) -> Iterator[Path]:
    """Yields the folder, or a temporary one; memory-mapped files stay readable after their removal."""
    if given is not None:
        yield Path(given)
        return
    with tempfile.TemporaryDirectory(prefix="vg2gt-windows-", ignore_cleanup_errors=True) as temporary:
        yield Path(temporary)


def with_far_shell(scene: Scene) -> Scene:
    """Returns the scene with a far shell for pixels that no view can place."""
    some = torch.arange(len(scene.names))
    if len(some) > AUTOMATIC:
        some = torch.tensor(list(spread(len(some), AUTOMATIC)))
    mask = None if scene.mask is None else scene.mask[some]
    shell = far_shell(scene.images[some], scene.depth[some], scene.cameras.to("cpu").select(some), mask)
    if shell is None:
        return scene
    return replace(scene, gaussians=scene.gaussians.joined(shell.to(scene.gaussians.means.device)))


def _scene(
    geometry: Geometry,
    gaussians: Gaussians,
    unit: float,
    views: Views,
    renderer: Renderer,
    is_metric: bool,
    wanted: FrameName,
) -> Scene:
    source = views.pictures[0].source
    kind = "predicted" if not source else "found" if source.startswith(SFM_SOURCE) else "given"
    check_frame(wanted, kind)
    known = [picture.pose for picture in views.pictures if picture.pose is not None]
    poses = np.stack(known) if kind != "predicted" and len(known) == len(views.names) else None
    frame = first_frame(geometry.cameras, unit, poses, kind, wanted)
    metres = float(geometry.scale) if is_metric else frame.scale if views.pictures[0].is_metric else None
    if not len(gaussians):
        raise ValueError("the backend found no depth in any image, so there is nothing to reconstruct")
    return Scene(
        gaussians=gaussians.detach(),
        cameras=geometry.cameras,
        images=views.images,
        depth=geometry.depth[0].cpu(),
        depth_conf=geometry.depth_conf[0].cpu(),
        names=views.names,
        renderer=renderer,
        metres_per_unit=metres,
        cameras_from=source,
        frame=frame,
        mask=views.mask,
        pictures=views.pictures,
    )
