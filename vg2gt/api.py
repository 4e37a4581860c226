"""What the command and Python share: a loaded model that turns images into a scene."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from vg2gt.inputs.cameras import Poses
from vg2gt.inputs.pictures import ImagesLike
from vg2gt.memory import RECONSTRUCTION, memory_advice, note_sizes
from vg2gt.monitor import Monitor
from vg2gt.outputs.output_names import SFM
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.policy import Quality, Refinement, read_options
from vg2gt.reconstruction.refined import refined_by_policy
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.windows import WINDOWS
from vg2gt.reconstruction.windows.run import device_of
from vg2gt.runs.load import LoadedModel, load_model
from vg2gt.runs.pretrained import weights_file
from vg2gt.types import check_choice


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
            size: longer side of the images in the model in pixels, or height and width; None: 518, on a CPU 280.
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
                sfm_folder=kept and kept / SFM,
                window=window,
                window_folder=kept and kept / WINDOWS,
                calibration=self.calibration,
            )
            return refined(scene, refine, quality, overrides, monitor)


def refined(
    scene: Scene, refine: Refinement, quality: Quality, overrides: Sequence[str], monitor: Monitor | None = None
) -> Scene:
    """Refines a scene unless it is to stay as it is (:func:`vg2gt.reconstruction.refined.refined_by_policy`).

    Raises:
        OutOfMemory: if the device's memory is full; the message says what takes less.
    """
    height, width = scene.cameras.size
    with memory_advice(RECONSTRUCTION):
        note_sizes({f"images of {height}x{width}": len(scene.names), "Gaussians": len(scene.gaussians)})
        return refined_by_policy(scene, refine, quality, overrides, monitor)


def check_refinement(refine: Refinement, quality: Quality, overrides: Sequence[str]) -> None:
    """Checks the options of a refinement before any work is done; arguments as for :meth:`Pipeline.reconstruct`.

    Raises:
        ValueError: if a name or a value is unknown or out of range; the message names it.
    """
    check_choice("quality", quality, Quality)
    options = read_options("photographs", overrides)
    if isinstance(refine, int) and refine:
        replace(options, steps=int(refine))  # checks the range


def load(
    name: str | Path | None = None,
    backend: str | None = None,
    *,
    overrides: Sequence[str] = (),
    revision: str | None = None,
    device: str = "auto",
) -> Pipeline:
    """Loads a model that turns images into scenes.

    Args:
        name: a run's folder or checkpoint, one of :func:`vg2gt.list_models`, a folder written by
            :func:`vg2gt.save_pretrained`, or ``OWNER/NAME`` on the Hugging Face Hub. None: the weights that ship with
            the package; with another backend than ``sweep``, an untrained head, which predicts coloured voxels.
        backend: an option of ``backend=``; None: the backend that the model was trained with.
        overrides: changes of the model's configuration as on the command line, such as
            ``["model.fine.max_voxels=500000"]``.
        revision: revision of a model on the Hub.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        The model in eval mode with its renderer, its calibration and the origin of its weights.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        OSError: if there is no such repository on the Hub.
        ImportError: if a package is missing that the backend or the Hub needs.
        ValueError: if a name or an option is unknown, or the model was trained on another backbone.
    """
    weights = None if name is None else weights_file(name, revision)
    return Pipeline(**vars(load_model(weights, backend, overrides, device)))
