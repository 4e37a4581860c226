"""Backend and dataset in a separate package (docs/guides/backend.md, docs/guides/dataset.md)."""

from torch.nn import functional as F

from backends.base import Backend
from vg2gt.data import RGBDFolder
from vg2gt.types import Geometry, Tokens


class BrightIsNear(Backend):
    """Predicts depth as 2 minus brightness; a token holds the colours of a patch, and cameras come from the data."""

    def __init__(self, patch_size: int = 14) -> None:
        dims = (3 * patch_size**2,)
        super().__init__("bright", patch_size, dims, "Apache-2.0", needs_hints=True, predicts_cameras=False)
        self.freeze()

    def encode(self, images, hints=None):
        """Returns the colours of patches as tokens."""
        hints = self.require_hints(images, hints, "cameras")
        patch = F.pixel_unshuffle(images.flatten(0, 1), self.patch_size).flatten(2).mT.unflatten(0, images.shape[:2])
        size = (images.shape[-2], images.shape[-1])
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        return Tokens((patch,), patch.mean(2), grid, size, {"cameras": hints.cameras})

    def decode(self, tokens):
        """Computes depth from the colours."""
        cells = tokens.patch[0].flatten(0, 1).mT.unflatten(-1, tokens.grid)
        depth = 2 - F.pixel_shuffle(cells, self.patch_size).mean(1).unflatten(0, tokens.camera.shape[:2])
        return Geometry(depth, depth * 0 + 1, tokens.state["cameras"], depth.new_ones(len(depth)))


class Centimetres(RGBDFolder):
    """RGB-D folders whose depth images are in centimetres, not millimetres."""

    def read_depth(self, index, row, size):
        """Returns depth in metres."""
        return super().read_depth(index, row, size) * 10
