"""Status and stated error of a scene's pixels and Gaussians, and removal of the untrusted ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vg2gt.inputs.camera_source import CameraSource
from vg2gt.types import Prediction
from vg2gt.uncertainty import STATED, Calibration
from vg2gt.visibility import Status, pixel_evidence

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

NAMES = {kind.name.lower(): kind for kind in Status}
_DOUBTS = {
    "single": "were seen by one view only (single)",
    "guessed": "fill places without measured depth (guessed)",
    "contradicted": "contradict other views (contradicted)",
    "unseen": "are seen by no view (unseen)",
}
_FEW = 0.5  # share of confirmed Gaussians below which the summary gives advice; a round number, not tuned
_ODD, _USUAL = 0.25, 0.2  # share of a view's pixels that contradict others from which it is odd, and of most views
_GIVEN = (
    ", or the given cameras do not fit the images (axes of another convention, another order, inverted poses): --poses "
    "sfm ignores them"
)
_COLORS = torch.tensor([[0.15, 0.15, 0.15], [0.45, 0.45, 0.45], [0.75, 0.1, 0.55]])  # unseen, guessed, contradicted
_RAMP = torch.tensor([[0.1, 0.3, 0.75], [0.2, 0.7, 0.5], [0.95, 0.85, 0.2], [0.85, 0.2, 0.1]])
_RAMP_ENDS = (0.003, 0.3)  # errors at its ends, logarithmic in between


def pixel_trust(
    prediction: Prediction, order: Sequence[int], mask: Tensor | None, calibration: Calibration | None
) -> tuple[Tensor | None, Tensor]:
    """Returns stated error and status of one scene's pixels, ``[V, H, W]`` each, in the given order of the views.

    Args:
        prediction: prediction for the views in processing order.
        order: indices of the views in processing order.
        mask: ``[V, H, W]`` in the given order; None: all pixels count.
        calibration: calibration of the model; None: no errors are stated.
    """
    evidence, status = pixel_evidence(prediction.geometry, prediction.supported)
    error = None if calibration is None else calibration.error(evidence, status)
    back = torch.tensor(order).argsort()
    status = status.cpu()[back]
    if mask is not None:
        status[mask <= 0.5] = Status.UNSEEN
    return None if error is None else error.cpu()[back], status


def odd_views(support: Tensor) -> list[int]:
    """Returns the views that contradict the others, if most of these agree: their cameras may be those of other images.

    With right cameras, at most about as many of a view's pixels contradicted others as agreed with them (four sets of
    photographs). Of two images with each other's camera, 25 to 82 % contradict, and few agree.

    Args:
        support: ``[V, H, W]`` :class:`vg2gt.visibility.Status` of each pixel.
    """
    against, agreed = (
        torch.stack([(view == kind).float().mean() for view in support])
        for kind in (Status.CONTRADICTED, Status.AGREED)
    )
    odd = (against > _ODD) & (agreed < against / 2)
    return odd.nonzero()[:, 0].tolist() if against.median() < _USUAL else []


def trusted(scene: Scene, min_confidence: float | None = None, drop: Sequence[str] = ()) -> Scene:
    """Returns the scene without untrusted Gaussians and depth.

    Args:
        scene: scene to filter; it is not changed.
        min_confidence: one minus the largest stated error to keep, in [0, 1]; None: keep all.
        drop: names of :class:`Status` values to remove, such as ``guessed``.

    Raises:
        ValueError: if a name is unknown, the number is out of range, support or errors are unknown, or no Gaussian
            would be left.
    """
    check_trust(min_confidence, drop)
    if min_confidence is None and not drop:
        return scene
    known = scene.gaussian_trust
    if known is None or scene.support is None:
        raise ValueError("--drop and --min-confidence need a scene with support: reconstruct it again")
    if min_confidence is not None and scene.error is None:
        raise ValueError("--min-confidence needs a calibration of the model: run vg2gt calibrate, or use --drop")
    unwanted = torch.tensor([NAMES[name] for name in drop])

    def stays(error: Tensor | None, status: Tensor) -> Tensor:
        good = ~torch.isin(status, unwanted)
        return good if error is None or min_confidence is None else good & (error <= 1 - min_confidence)

    kept = stays(known.get("error"), known["support"])
    if not kept.any():
        raise ValueError("no Gaussian is left: lower --min-confidence or drop less")
    gaussians = scene.gaussians.select(kept.to(scene.gaussians.means.device))
    depth = torch.where(stays(scene.error, scene.support), scene.depth, 0.0)
    left = replace(scene, gaussians=gaussians, depth=depth)
    # Keep the support that the Gaussians got from all depth, including the removed depth.
    left.__dict__["gaussian_trust"] = {name: values[kept] for name, values in known.items()}
    return left


def check_trust(min_confidence: float | None, drop: Sequence[str]) -> None:
    """Checks the options of :func:`trusted`.

    Raises:
        ValueError: if a name is unknown or the number is out of range.
    """
    if min_confidence is not None and not 0 <= min_confidence <= 1:
        raise ValueError(f"--min-confidence {min_confidence}: give a number from 0 to 1, such as 0.95")
    for name in drop:
        if name not in NAMES:
            raise ValueError(f"--drop {name}: unknown; choose from {', '.join(NAMES)}")


def trust_figures(scene: Scene) -> dict[str, Any]:
    """Returns report entries: shares of pixels and Gaussians by status, and median stated errors; empty if unknown."""
    known = scene.gaussian_trust
    if known is None or scene.support is None:
        return {}
    figures: dict[str, Any] = {"pixels": _shares(scene.support), "gaussians": _shares(known["support"])}
    if scene.error is not None and (scene.depth > 0).any():
        figures["level"] = STATED
        figures["error_of_pixels"] = float(f"{float(scene.error[scene.depth > 0].median()):.3g}")
    return {"trust": figures}


def trust_lines(scene: Scene) -> list[str]:
    """Returns sentences for a terminal: which part of a scene is confirmed, its depth errors, and what may help."""
    figures = trust_figures(scene).get("trust")
    if figures is None:
        return ["how many views confirm a Gaussian is not known for this scene"]
    shares = figures["gaussians"]
    rest = [f"{100 * shares[name]:.0f} % {said}" for name, said in _DOUBTS.items() if shares[name] >= 0.005]
    lines = [f"Gaussians: {100 * shares['agreed']:.0f} % are confirmed by two or more views"]
    if rest:
        lines[0] += f"; {', '.join(rest)}; remove some by --drop LIST"
    if shares["agreed"] < _FEW:
        given = CameraSource.of(scene.cameras_from) is CameraSource.GIVEN
        lines.append(f"few views agree: take more photographs in smaller steps{_GIVEN if given else ''}")
    if "error_of_pixels" not in figures:
        return [*lines, "depth errors are not stated: there is no calibration of this model (vg2gt calibrate)"]
    when = " before refinement" if scene.refined is not None else ""
    error, sure = 100 * figures["error_of_pixels"], round(10 * STATED)
    return [
        *lines,
        f"depth error of a typical pixel{when}: at most {error:.2g} % (such limits hold for {sure} of 10 pixels)",
    ]


def trust_picture(error: Tensor | None, support: Tensor) -> Tensor:
    """Returns colours ``[3, ...]`` of stated errors and status ``[...]``: from blue (0.3 %) to red (30 % and more).

    Unseen is dark grey, guessed grey and contradicted purple. Without errors, blue means that several views agree, and
    yellow that a single view measured the depth.
    """
    if error is None:
        place = torch.where(support == Status.AGREED, 0.0, 2 / 3)
    else:
        low, high = torch.tensor(_RAMP_ENDS).log()
        place = ((error.clamp(min=1e-6).log() - low) / (high - low)).clamp(0, 1)
    at = place * (len(_RAMP) - 1)
    left = at.long().clamp(max=len(_RAMP) - 2)
    color = torch.lerp(_RAMP[left], _RAMP[left + 1], (at - left)[..., None])
    flat = _COLORS[support.long().clamp(max=len(_COLORS) - 1)]
    return torch.where((support <= Status.CONTRADICTED)[..., None], flat, color).movedim(-1, 0)


def _shares(status: Tensor) -> dict[str, float]:
    return {kind.name.lower(): round(float((status == kind).float().mean()), 4) for kind in reversed(Status)}
