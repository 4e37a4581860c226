"""How a scene is refined by default: one policy for the command and Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from hydra.utils import instantiate

from vg2gt.config import compose_groups
from vg2gt.inputs.camera_source import CameraSource
from vg2gt.reconstruction.photographs import of_full_size
from vg2gt.reconstruction.windows.store import AUTOMATIC
from vg2gt.refinement import RefineOptions, RefineRates
from vg2gt.types import check_choice

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

# Factor on the steps at the working size if there is no stage at full size. 280 pixels, held-out photographs, 3 instead
# of 1: bananas and a tree gain 0.7 and 0.6 dB, a beach loses 0.2 dB.
_ALONE = 3

Quality = Literal["draft", "normal", "high"]
Refinement = bool | int | RefineOptions | None
"""Whether and how a scene is refined: by the policy (True), never (False or 0), for a number of steps at the working
size, with given options, or None: if :func:`refined_by_default`."""


def refined_by_default(scene: Scene) -> bool:
    """Returns whether ``vg2gt reconstruct`` refines a scene without being told: up to 100 photographs."""
    return scene.camera_source is not CameraSource.RECORDED and len(scene.names) <= AUTOMATIC


def refinement_for(
    scene: Scene, quality: Quality = "normal", overrides: Sequence[str] = (), **changes: float | None
) -> RefineOptions:
    """Returns the options of a scene's refinement.

    Args:
        scene: the scene. Recordings are refined by ``configs/refine/default.yaml``, all others by
            ``photographs.yaml``, ``draft.yaml`` or ``high.yaml``, according to ``quality``.
        quality: ``draft`` stays at the working size; ``high`` takes eight times as many steps at full size
            as ``normal``. Photographs that are hardly larger than the working size are refined at that size only, in
            three times as many steps.
        overrides: Hydra overrides: ``refine=NAME`` and ``refine.key=value``.
        **changes: options that are set after the overrides unless they are None, such as ``seconds``, which alone
            replaces the default number of steps.

    Raises:
        ValueError: if an override or the quality is unknown.
    """
    check_choice("quality", quality, Quality)
    recorded = scene.camera_source is CameraSource.RECORDED
    name = "default" if recorded else {"normal": "photographs"}.get(quality, quality)
    predicted = scene.camera_source is CameraSource.PREDICTED and not _choose_config(overrides)
    moved = [f"refine.rates.cameras={RefineRates().cameras}"] if predicted else []  # unless an override says otherwise
    found = read_options(name, [*moved, *overrides])
    given: dict[str, Any] = {key: value for key, value in changes.items() if value is not None}
    if found.full is not None and of_full_size(scene, found) is None:
        # the working size is all there is, and gets all steps
        asked = any(override.startswith("refine.steps=") for override in overrides)
        steps = found.steps if asked or found.steps is None else _ALONE * found.steps
        found = replace(found, steps=steps, full=None)
    if "seconds" in given and found.full is None:
        given = {"steps": None, **given}
    return replace(found, **given)


def chosen_refinement(
    scene: Scene, refine: Refinement = None, quality: Quality = "normal", overrides: Sequence[str] = ()
) -> RefineOptions | None:
    """Returns the options of a scene's refinement, None if it is not to be refined.

    Args:
        scene: the scene.
        refine: whether and how (:data:`Refinement`); None with overrides refines.
        quality: see :func:`refinement_for`.
        overrides: see :func:`refinement_for`.

    Raises:
        ValueError: if an override or the quality is unknown.
    """
    if isinstance(refine, RefineOptions):
        return refine
    if refine is None:
        refine = bool(overrides) or refined_by_default(scene)
    if refine is True:
        return refinement_for(scene, quality, overrides)
    return replace(refinement_for(scene, quality, overrides, steps=refine), full=None) if refine else None


def check_refinement(refine: Refinement, quality: Quality, overrides: Sequence[str]) -> None:
    """Checks the options of a refinement (:func:`chosen_refinement`) before any work is done.

    Raises:
        ValueError: if a name or a value is unknown or out of range; the message names it.
    """
    check_choice("quality", quality, Quality)
    options = read_options("photographs", overrides)
    if isinstance(refine, int) and refine:
        replace(options, steps=int(refine))  # checks the range


def read_options(name: str, overrides: Sequence[str]) -> RefineOptions:
    """Builds the options of ``refine=NAME refine.key=value``; ``name`` is used if the overrides choose none."""
    first = [] if _choose_config(overrides) else [f"refine={name}"]
    return instantiate(compose_groups(*first, *overrides).refine)


def _choose_config(overrides: Sequence[str]) -> bool:
    return any(override.startswith("refine=") for override in overrides)
