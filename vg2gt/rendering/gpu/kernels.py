"""All Triton kernels of the renderer, in the order in which a step launches them."""

from vg2gt.rendering.gpu.binning import emit_kernel, list_kernel
from vg2gt.rendering.gpu.projection import project_kernel
from vg2gt.rendering.gpu.projection_backward import project_backward_kernel
from vg2gt.rendering.gpu.tiles import backward_kernel, blend_kernel

__all__ = [
    "backward_kernel",
    "blend_kernel",
    "emit_kernel",
    "list_kernel",
    "project_backward_kernel",
    "project_kernel",
]
