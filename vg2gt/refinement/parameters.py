"""Parameters of a refinement: one scene's Gaussians, and the cameras and exposures of its views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.alignment import Similarity
from vg2gt.geometry.cameras import compose, invert_rigid
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.kernels.adam import RowUpdate, bias_corrections, update_rows
from vg2gt.refinement.options import RefineRates
from vg2gt.types import Cameras, Gaussians, TensorRecord

BETAS = (0.9, 0.99)
EPSILON = 1e-8  # of Adam
# rate of the higher spherical harmonics relative to that of the constant one: with 0.05, as in 3DGS, which takes a
# hundred times as many steps, a set of photographs lost 0.4 dB; 0.5 lost 0.1 to 0.4 dB
_HIGHER_BANDS = 0.2
# largest standard deviation in middle ones: longer Gaussians are strokes from where no photograph was taken
LONGEST = 4.0
_LOGIT_MARGIN = 1e-4
_TRANSPARENT = 0.02  # opacity below which Gaussians are removed
_OF_GAUSSIANS = ("means", "quats", "scales", "opacities", "sh", "sh_rest")


@dataclass(frozen=True)
class RefinedScene(TensorRecord):
    """State of a refinement.

    Attributes:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        gain: ``[V, 3]`` factors from rendered colours to those of a view's image.
        bias: ``[V, 3]`` offsets added after the gain.
    """

    gaussians: Gaussians
    cameras: Cameras
    gain: Tensor
    bias: Tensor

    def seen_from(self, first: Tensor) -> RefinedScene:
        """Returns the same scene, with the same renderings, in the world where view 0 has the pose ``first [4, 4]``."""
        found = self.cameras.world_to_camera[0]
        back = compose(invert_rigid(found[0]), first)  # from the new world to the old one
        move = invert_rigid(back)[None]
        similarity = Similarity(torch.ones_like(move[:, 0, 0]), move[:, :3, :3], move[:, :3, 3])
        poses = torch.cat((first[None], compose(found[1:], back)))
        cameras = replace(self.cameras, world_to_camera=poses[None])
        return replace(self, gaussians=similarity.apply_gaussians(self.gaussians), cameras=cameras)

    def with_degree(self, degree: int | None) -> RefinedScene:
        """Returns the scene with colours of at least a degree of spherical harmonics; None: with its own."""
        missing = 0 if degree is None else (degree + 1) ** 2 - self.gaussians.sh.shape[1]
        if missing <= 0:
            return self
        return replace(self, gaussians=replace(self.gaussians, sh=F.pad(self.gaussians.sh, (0, 0, 0, missing))))

    def exposed(self, color: Tensor, views: Tensor) -> Tensor:
        """Applies the exposure of the views ``[R]`` to rendered colours ``[1, R, 3, H, W]``."""
        gain, bias = self.gain[views], self.bias[views]
        if not (gain.requires_grad or bias.requires_grad or (gain != 1).any() or bias.any()):
            return color
        return color * gain[:, :, None, None] + bias[:, :, None, None]


class Parameters:
    """Unconstrained parameters of a scene, with Adam's moments.

    A step may concern some Gaussians only, such as those in front of a crop: the others keep values and moments, which
    saves most of a step's time. Positions move in units of each Gaussian's middle standard deviation, measured at the
    start and after splits, so that one rate fits small and large Gaussians and every scene's unit. Cameras rotate and
    shift in their own frames. View 0 is optimised too: otherwise an error of its pose would have to be compensated by
    all other views and Gaussians (:meth:`RefinedScene.seen_from` restores its pose).

    Args:
        start: initial state.
        rates: learning rates.
        pixel: size of a pixel at the scene's median depth relative to that depth: the unit of rotations and, times
            ``depth``, of shifts.
        depth: median depth in scene units.
        trained: ``[N]`` views whose exposures are 1 in the mean, since the scene's colours represent it.

    Attributes:
        values: the parameters by name; those of Gaussians have one row each.
        unit: ``[G]`` unit in which positions move.
        seen: ``[G]`` 1 for Gaussians that trained views show, else 0: nothing but the penalty on opacity would reach
            the others, and remove them. 1 for all at first.
        least: ``[G]`` logarithm of the smallest standard deviation that a step may reach; -inf for all at first.
        moments: Adam's two moments by name; ``counts`` are the numbers of updates they hold, ``[G]`` or one number.
    """

    def __init__(self, start: RefinedScene, rates: RefineRates, pixel: float, depth: float, trained: Tensor) -> None:
        gaussians = start.gaussians
        self.start = start
        self.pixel, self.depth, self.trained = pixel, depth, trained.to(gaussians.means.device)
        self.unit = gaussians.scales.median(-1).values
        self.seen = torch.ones_like(gaussians.opacities)
        self.least = torch.full_like(self.seen, -math.inf)
        self.values = {
            "means": gaussians.means.clone(),
            "quats": F.normalize(gaussians.quats, dim=-1),
            "scales": gaussians.scales.log(),
            "opacities": torch.logit(gaussians.opacities.clamp(_LOGIT_MARGIN, 1 - _LOGIT_MARGIN)),
            "sh": gaussians.sh[:, :1].clone(),
            "sh_rest": gaussians.sh[:, 1:].clone(),
            "cameras": gaussians.means.new_zeros(len(start.gain), 6),
            "gain": start.gain.log(),
            "bias": start.bias.clone(),
        }
        exposure = rates.exposure or 0.0
        self.rates = {**vars(rates), "sh_rest": _HIGHER_BANDS * rates.sh, "gain": exposure, "bias": exposure}
        self.moments = {name: (torch.zeros_like(value), torch.zeros_like(value)) for name, value in self.values.items()}
        self.counts = torch.zeros_like(self.unit)
        self.steps = 0
        self._rows: Tensor | None = None
        self._leaves: dict[str, Tensor] = {}

    def __len__(self) -> int:
        return len(self.unit)

    def scene(self, rows: Tensor | None = None) -> RefinedScene:
        """Returns the current scene with autograd graph; ``rows [N]``: with these Gaussians only, in this order."""
        self._rows = rows
        self._leaves = values = {
            name: (
                value.clone() if rows is None or name not in _OF_GAUSSIANS else value.index_select(0, rows)
            ).requires_grad_(bool(self.rates[name]))
            for name, value in self.values.items()
        }
        start = self.start
        gaussians = Gaussians(
            values["means"],
            F.normalize(values["quats"], dim=-1),
            values["scales"].exp(),
            torch.sigmoid(values["opacities"]),
            torch.cat((values["sh"], values["sh_rest"]), 1),
            torch.zeros(len(values["means"]), dtype=torch.int64, device=self.unit.device),
            start.gaussians.background,
        )
        gain, bias = self._centred(values["gain"]).exp(), self._centred(values["bias"])
        return RefinedScene(gaussians, self._moved(values["cameras"]), gain, bias)

    def present(self) -> RefinedScene:
        """Returns the current scene without autograd graph."""
        return self.scene().detach()

    @property
    def cameras(self) -> Cameras:
        """The current cameras, without autograd graph."""
        return self._moved(self.values["cameras"])

    def _centred(self, exposure: Tensor) -> Tensor:
        """Returns exposures ``[V, 3]`` minus the mean of the trained views."""
        trained = exposure[self.trained]
        return exposure.index_copy(0, self.trained, trained - trained.mean(0))

    def _moved(self, moves: Tensor) -> Cameras:
        """Returns the initial cameras after rotations and shifts ``[V, 6]``."""
        cameras = self.start.cameras
        if not self.rates["cameras"]:
            return cameras
        moves = self.pixel * moves
        turn = quat_to_matrix(F.pad(moves[:, :3] / 2, (1, 0), value=1.0))
        top = torch.cat((turn, self.depth * moves[:, 3:, None]), -1)
        increment = torch.cat((top, cameras.world_to_camera[0, :, 3:]), -2)
        return replace(cameras, world_to_camera=compose(increment, cameras.world_to_camera[0])[None])

    def step(self, loss: Tensor, share: float) -> bool:
        """Updates what the last :meth:`scene` holds by one step of Adam (Kingma & Ba, 2015).

        Args:
            loss: loss of that scene.
            share: factor on all rates.

        Returns:
            False, without a change, if a gradient is not finite.
        """
        if not loss.requires_grad:  # all rates are 0
            return bool(loss.isfinite())
        loss.backward()
        grads = {name: leaf.grad for name, leaf in self._leaves.items() if leaf.grad is not None and leaf.numel()}
        if not torch.stack([grad.sum() for grad in grads.values()]).isfinite().all():
            return False
        every = torch.arange(len(self), device=self.counts.device)
        rows = every if self._rows is None else self._rows
        self.steps += 1
        self.counts[rows] += 1
        of_gaussians = (rows, bias_corrections(self.counts[rows], BETAS))
        views = torch.arange(len(self.values["cameras"]), device=rows.device)  # every step changes all of them
        of_views = (views, bias_corrections(torch.full_like(self.values["cameras"][:, 0], self.steps), BETAS))
        for name, grad in grads.items():
            if rate := share * self.rates[name]:
                value, moments = self.values[name], self.moments[name]
                unit = self.unit if name == "means" else value.new_ones(len(value))
                which = of_gaussians if name in _OF_GAUSSIANS else of_views
                update_rows(RowUpdate(value, moments, grad, *which, unit, BETAS, EPSILON, rate))
        scales = self.values["scales"][rows]
        longest = scales.median(-1, keepdim=True).values + math.log(LONGEST)
        self.values["scales"][rows] = scales.minimum(longest).maximum(self.least[rows, None])
        return True

    @torch.no_grad()
    def prune(self) -> None:
        """Removes transparent Gaussians, unless all are."""
        keep = torch.sigmoid(self.values["opacities"]) >= _TRANSPARENT
        if not keep.all() and keep.any():
            self.keep(keep)

    def keep(self, rows: Tensor) -> None:
        """Keeps the Gaussians of a mask or an index ``rows`` only, with their moments."""
        self._replace(lambda values: values[rows])

    @torch.no_grad()
    def split(self, rows: Tensor, shrink: float, offset: float) -> None:
        """Splits Gaussians in two along their longest axis.

        Both halves keep the moments and the number of updates.

        Args:
            rows: ``[N]`` index of those to split; the second halves are appended in this order.
            shrink: factor on the standard deviation along that axis.
            offset: shift of either half from the middle, in former standard deviations.
        """
        scales = self.values["scales"][rows].exp()
        axis = scales.argmax(-1)
        turn = quat_to_matrix(F.normalize(self.values["quats"][rows], dim=-1))
        picked = torch.arange(len(rows), device=rows.device)
        shift = offset * turn[picked, :, axis] * scales[picked, axis][:, None]
        self.values["scales"][rows, axis] += math.log(shrink)
        self._replace(lambda values: torch.cat((values, values[rows])))
        self.values["means"][rows] += shift
        self.values["means"][-len(rows) :] -= shift
        self._measure()

    def _measure(self) -> None:
        """Sets the unit of positions to the present sizes; the moments of positions are in this unit, too."""
        unit = self.values["scales"].median(-1).values.exp()
        ratio = (unit / self.unit)[:, None]
        self.unit = unit
        first, second = self.moments["means"]
        self.moments["means"] = (first * ratio, second * ratio.square())

    def _replace(self, change: Callable[[Tensor], Tensor]) -> None:
        """Applies a change of rows to all that is known of the Gaussians."""
        unit, seen, least, counts = map(change, (self.unit, self.seen, self.least, self.counts))
        values = self.values | {name: change(self.values[name]) for name in _OF_GAUSSIANS}
        moments = self.moments | {name: _both(change, self.moments[name]) for name in _OF_GAUSSIANS}
        # at once, because Ctrl-C during the copies must leave a scene that fits together
        self.unit, self.seen, self.least, self.counts = unit, seen, least, counts
        self.values, self.moments = values, moments


def _both(change: Callable[[Tensor], Tensor], moments: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return change(moments[0]), change(moments[1])
