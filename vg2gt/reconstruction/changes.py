"""Adds images to a scene that was made in windows, and removes them again."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import torch

from vg2gt.model import VG2GT
from vg2gt.reconstruction.cameras import pictures_for
from vg2gt.reconstruction.frame import moved_gaussians, similarity_of
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.output_names import WINDOWS
from vg2gt.reconstruction.pictures import ImagesLike
from vg2gt.reconstruction.pipeline import reconstruct_with, with_far_shell
from vg2gt.reconstruction.saved import read_scene
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.windows.capture import window_size
from vg2gt.reconstruction.windows.run import gaussians_of, set_key, window_model
from vg2gt.reconstruction.windows.sets import Anchor, finished_sets, joined, read_anchor, without
from vg2gt.reconstruction.windows.store import key_of
from vg2gt.rendering import Renderer


def add_images(
    model: VG2GT, folder: Path, images: ImagesLike, renderer: Renderer, monitor: Monitor, window: int | None = None
) -> Scene:
    """Adds images, whose cameras are given in the same frame, to the scene in a folder; writes no outputs.

    Args:
        model: model that made the scene.
        folder: output folder of ``vg2gt reconstruct --keep-windows``.
        images: see :func:`vg2gt.reconstruction.pictures.find_pictures`.
        renderer: renderer of the scene.
        monitor: shows and times the stages.
        window: see :func:`vg2gt.reconstruction.pipeline.reconstruct_with`.

    Returns:
        The scene with the images.

    Raises:
        FileNotFoundError: if the folder keeps no voxels.
        ValueError: if another model made the scene, or it already has images of the same names.
    """
    old, anchor = read_scene(folder, renderer, _device(model)), _anchor(model, folder)
    with pictures_for(model, images, "given") as pictures:
        there = sorted({picture.name for picture in pictures} & set(old.names))
    if there:
        raise ValueError(f"the scene already has images with these names: {', '.join(there[:10])}; rename them")
    new = reconstruct_with(
        model,
        images,
        renderer=renderer,
        monitor=monitor,
        poses="given",
        frame="given",
        window=window,
        window_folder=folder / WINDOWS,
        anchor=anchor,
    )
    scene = joined(old, new)
    return scene if model.visibility is None else with_far_shell(scene)


def take_out(
    model: VG2GT, folder: Path, images: ImagesLike, renderer: Renderer, monitor: Monitor, window: int | None = None
) -> Scene:
    """Removes images that one command added from the scene in a folder; arguments as for :func:`add_images`.

    Raises:
        FileNotFoundError: if the folder keeps no voxels.
        ValueError: if another model made the scene, or exactly these images were not added together.
    """
    old, anchor, kept = read_scene(folder, renderer, _device(model)), _anchor(model, folder), folder / WINDOWS
    with pictures_for(model, images, "given") as pictures:
        names = {picture.name for picture in pictures}
        size = window_size(window, len(pictures), kept=True)
        place = kept / set_key(model, pictures, anchor.size, size, anchor)[:12]
    if place not in finished_sets(kept):
        raise ValueError("these images were not added by one command: give the same folder and the same --window")
    scene = without(old, names)
    gaussians = gaussians_of(model, kept, anchor, monitor, left_out=place)
    scene = replace(scene, gaussians=moved_gaussians(gaussians, similarity_of(anchor.to_source)))
    shutil.rmtree(place)
    return scene if model.visibility is None else with_far_shell(scene)


def _anchor(model: VG2GT, folder: Path) -> Anchor:
    anchor = read_anchor(folder / WINDOWS)
    if anchor.model != key_of(window_model(model)):
        raise ValueError(f"{folder} was made with another model: take the same backend, checkpoint and options")
    return anchor


def _device(model: VG2GT) -> torch.device:
    return next((parameter.device for parameter in model.parameters()), torch.device("cpu"))
