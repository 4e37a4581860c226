"""Example of a custom loss term, which makes rendered views opaque.

python train.py loss.gaussian._target_=examples.loss.OpaqueGaussianLoss +loss.gaussian.opaque=0.1
"""

from dataclasses import dataclass

from torch import Tensor

from vg2gt.losses.gaussian import GaussianLoss, RenderTargets
from vg2gt.types import Cameras, Render


@dataclass(frozen=True)
class OpaqueGaussianLoss(GaussianLoss):
    """The paper's losses on rendered views, and one more term.

    Args:
        opaque: weight of the mean transmittance of the pixels. A field with the name of a term is its weight.
    """

    opaque: float = 0.1

    def __call__(self, rendered: Render, cameras: Cameras, targets: RenderTargets, scale: Tensor) -> dict[str, Tensor]:
        """Returns the unweighted terms of one scene; each is weighted, summed and logged by its name."""
        terms = super().__call__(rendered, cameras, targets, scale)
        return terms | {"opaque": (1 - rendered.alpha).mean()}
