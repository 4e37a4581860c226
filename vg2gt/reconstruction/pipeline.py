"""From images to a scene in one call."""

from __future__ import annotations

from collections.abc import Sequence
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
from vg2gt.reconstruction.inputs import Views, load_views, working_size
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.order import as_given, in_order, working_order
from vg2gt.reconstruction.pictures import SFM_SOURCE, ImagesLike
from vg2gt.reconstruction.scene import Scene
from vg2gt.rendering import Renderer
from vg2gt.runs.load import load_model
from vg2gt.types import Prediction


def reconstruct(
    images: ImagesLike,
    ckpt: str | Path | None = None,
    backend: str | None = None,
    *,
    every: int = 1,
    max_images: int | None = None,
    size: int | tuple[int, int] | None = None,
    device: str = "auto",
) -> Scene:
    """Builds a model and reconstructs a scene: :func:`load_model`, then :func:`reconstruct_with`."""
    ready = load_model(ckpt, backend, device=device)
    return reconstruct_with(ready.model, images, every=every, max_images=max_images, size=size, renderer=ready.renderer)


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
) -> Scene:
    """Reconstructs a scene from any number of images.

    Args:
        model: the model; it is put into eval mode.
        images: see :func:`vg2gt.reconstruction.pictures.find_pictures`.
        every: take every this many-th image only.
        max_images: take at most so many, evenly spread.
        size: see :func:`vg2gt.reconstruction.working_size`.
        renderer: how the scene will be rendered; None: as solids, with the default options.
        monitor: shows and times the stages.
        poses: where cameras come from, see :func:`vg2gt.reconstruction.cameras.pictures_for`.
        sfm_folder: where cameras that structure from motion finds are kept, and found again; None: they are not.
        frame: the scene's frame and unit (:class:`vg2gt.reconstruction.frame.SceneFrame`): ``given`` cameras',
            ``first`` camera's, ``upright``, or ``auto``.
        skip_damaged: skip images that cannot be read, with a warning; otherwise they are an error.

    Returns:
        The scene, in the frame that was asked for; its Gaussians stay on the model's device.

    Raises:
        FileNotFoundError: if a path does not exist.
        ImportError: if cameras must be found and there is no pycolmap.
        ValueError: if there are no images, one cannot be read, or the backend needs what they do not have.
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
        target = working_size([p.size for p in pictures], model.backend.patch_size, device.type, size)
        note_sizes({f"images of {target[0]}x{target[1]}": len(pictures)})
        views = load_views(pictures, target, monitor)
        order = working_order(views.images)
        prediction = _forward(model.eval(), views, order, device, monitor)
    scene = _scene(prediction, views, order, renderer or Renderer(), model.backend.is_metric, frame)
    scene = scene if model.visibility is None else _with_far_shell(scene)
    return scene.placed()


def _forward(
    model: Reconstructor, views: Views, order: Sequence[int], device: torch.device, monitor: Monitor
) -> Prediction:
    ordered, hints = in_order(views, order)
    images, hints = ordered[None].to(device), hints.to(device)
    with monitor.stage("reconstruct"), monitor.watching(), half_precision_on_gpu(images):
        return model(images, hints)


def _with_far_shell(scene: Scene) -> Scene:
    """The scene with a far shell for pixels that no view can place."""
    shell = far_shell(scene.images, scene.depth, scene.cameras.to("cpu"), scene.mask)
    if shell is None:
        return scene
    return replace(scene, gaussians=scene.gaussians.joined(shell.to(scene.gaussians.means.device)))


def _scene(
    prediction: Prediction,
    views: Views,
    order: Sequence[int],
    renderer: Renderer,
    is_metric: bool,
    wanted: FrameName,
) -> Scene:
    geometry = as_given(prediction.surface.detach(), order)
    source = views.pictures[0].source
    kind = "predicted" if not source else "found" if source.startswith(SFM_SOURCE) else "given"
    check_frame(wanted, kind)
    known = [picture.pose for picture in views.pictures if picture.pose is not None]
    poses = np.stack(known) if kind != "predicted" and len(known) == len(views.names) else None
    unit = float(prediction.unit)
    frame = first_frame(geometry.cameras, unit, poses, kind, wanted)
    metres = float(geometry.scale) if is_metric else frame.scale if views.pictures[0].is_metric else None
    if not len(prediction.gaussians):
        raise ValueError("the backend found no depth in any image, so there is nothing to reconstruct")
    return Scene(
        gaussians=prediction.gaussians.detach(),
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
