"""Parameters of a refinement: one scene's Gaussians, and the cameras and exposures of its views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.alignment import Similarity
from vg2gt.geometry.cameras import compose, invert_rigid
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.refinement.options import RefineRates
from vg2gt.types import Cameras, Gaussians, TensorRecord

BETAS = (0.9, 0.99)
HIGHER_BANDS = 0.05  # rate of the higher spherical harmonics relative to that of the constant one
LOGIT_MARGIN = 1e-4
TRANSPARENT = 0.02  # opacity below which Gaussians are removed
OF_GAUSSIANS = ("means", "quats", "scales", "opacities", "sh", "sh_rest")


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

    def exposed(self, color: Tensor, views: Tensor) -> Tensor:
        """Applies the exposure of the views ``[R]`` to rendered colours ``[1, R, 3, H, W]``."""
        return color * self.gain[views, :, None, None] + self.bias[views, :, None, None]


class Parameters:
    """Unconstrained parameters of a scene, with their optimiser.

    Positions are offsets in units of each Gaussian's middle standard deviation, so that one rate fits small and large
    Gaussians and every scene's unit. Cameras rotate and shift in their own frames. View 0 is optimised too: otherwise
    an error of its pose would have to be compensated by all other views and Gaussians
    (:meth:`RefinedScene.seen_from` restores its pose).

    Args:
        start: initial state.
        rates: learning rates.
        pixel: size of a pixel at the scene's median depth relative to that depth: the unit of rotations and, times
            ``depth``, of shifts.
        depth: median depth in scene units.
        trained: ``[N]`` views to train on; exposures of the others stay fixed.
    """

    def __init__(self, start: RefinedScene, rates: RefineRates, pixel: float, depth: float, trained: Tensor) -> None:
        gaussians = start.gaussians
        self.start = start
        self.pixel, self.depth, self.trained = pixel, depth, trained
        self.origin = gaussians.means
        self.unit = gaussians.scales.median(-1).values
        self.size = gaussians.scales.max(-1).values
        self.values = {
            "means": torch.zeros_like(gaussians.means),
            "quats": F.normalize(gaussians.quats, dim=-1),
            "scales": gaussians.scales.log(),
            "opacities": torch.logit(gaussians.opacities.clamp(LOGIT_MARGIN, 1 - LOGIT_MARGIN)),
            "sh": gaussians.sh[:, :1].clone(),
            "sh_rest": gaussians.sh[:, 1:].clone(),
            "cameras": gaussians.means.new_zeros(len(start.gain), 6),
            "gain": start.gain.log(),
            "bias": start.bias.clone(),
        }
        self.rates = {**vars(rates), "sh_rest": HIGHER_BANDS * rates.sh, "gain": rates.exposure, "bias": rates.exposure}
        groups = []
        for name, value in self.values.items():
            if self.rates[name] and value.numel():
                groups.append({"params": [value.requires_grad_(True)], "lr": self.rates[name], "name": name})
        self.optimizer = torch.optim.Adam(groups, betas=BETAS)

    def scene(self) -> RefinedScene:
        """Returns the current scene with autograd graph."""
        values, start = self.values, self.start
        gaussians = Gaussians(
            self.origin + self.unit[:, None] * values["means"],
            F.normalize(values["quats"], dim=-1),
            values["scales"].exp(),
            torch.sigmoid(values["opacities"]),
            torch.cat((values["sh"], values["sh_rest"]), 1),
            torch.zeros(len(self.origin), dtype=torch.int64, device=self.origin.device),
            start.gaussians.background,
        )
        gain, bias = self._centred(values["gain"]).exp(), self._centred(values["bias"])
        return RefinedScene(gaussians, self._cameras(start.cameras), gain, bias)

    def _centred(self, exposure: Tensor) -> Tensor:
        """Returns exposures ``[V, 3]`` minus the mean of the trained views, which the scene's colours represent."""
        trained = exposure[self.trained]
        return exposure.index_copy(0, self.trained, trained - trained.mean(0))

    def _cameras(self, cameras: Cameras) -> Cameras:
        if not self.rates["cameras"]:
            return cameras
        moves = self.pixel * self.values["cameras"]
        turn = quat_to_matrix(F.pad(moves[:, :3] / 2, (1, 0), value=1.0))
        top = torch.cat((turn, self.depth * moves[:, 3:, None]), -1)
        increment = torch.cat((top, cameras.world_to_camera[0, :, 3:]), -2)
        return replace(cameras, world_to_camera=compose(increment, cameras.world_to_camera[0])[None])

    def step(self, loss: Tensor, share: float) -> bool:
        """Runs an Adam step with rates scaled by ``share``; returns False, without it, if a gradient is not finite."""
        self.optimizer.zero_grad()
        loss.backward()
        for group in self.optimizer.param_groups:
            group["lr"] = share * self.rates[group["name"]]
        grads = [group["params"][0].grad for group in self.optimizer.param_groups]
        if not torch.stack([grad.sum() for grad in grads if grad is not None]).isfinite().all():
            return False
        self.optimizer.step()
        return True

    @torch.no_grad()
    def prune(self) -> None:
        """Removes transparent Gaussians with their Adam state, unless all are."""
        keep = torch.sigmoid(self.values["opacities"]) >= TRANSPARENT
        if keep.all() or not keep.any():
            return
        self.origin, self.unit, self.size = self.origin[keep], self.unit[keep], self.size[keep]
        groups = {group["name"]: group for group in self.optimizer.param_groups}
        for name in OF_GAUSSIANS:
            before = self.values[name]
            after = self.values[name] = before[keep].detach()
            if name not in groups:
                continue
            groups[name]["params"][0] = after.requires_grad_(True)
            state = self.optimizer.state.pop(before, None)
            if state is not None:
                moments = {key: state[key][keep] for key in ("exp_avg", "exp_avg_sq")}
                self.optimizer.state[after] = {"step": state["step"], **moments}
