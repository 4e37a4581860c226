"""The compiled count of :mod:`vg2gt.visibility.counts`."""

from __future__ import annotations

import numpy as np

from vg2gt.kernels.compiled import kernel

NEAREST = 1e-6  # smallest depth in another camera, in scene units
HEAVIEST = 2.0  # largest weight of a view that is nearer to the point than the pixel's own


@kernel(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", nogil=True)
def count_view(view, depth, partners, matrix, tolerance, margin, weighted, agree, through, hidden):
    """Counts for one view's pixels; ``matrix`` ``[V, K, 3, 4]`` maps ``depth * (x, y, 1)`` to a partner's image.

    ``weighted`` counts a view by the pixel's depth over the point's depth in that view, at most :data:`HEAVIEST`.
    """
    height, width = depth.shape[1:]
    one, half = np.float32(1), np.float32(0.5)
    most = one - margin
    for k in range(partners.shape[1]):
        other = partners[view, k]
        if other < 0:
            continue
        m = matrix[view, k]
        for y in range(height):
            for x in range(width):
                d = depth[view, y, x]
                if d <= 0:
                    continue
                fx, fy = np.float32(x), np.float32(y)
                z = (m[2, 0] * fx + m[2, 1] * fy + m[2, 2]) * d + m[2, 3]
                if z <= np.float32(NEAREST):
                    continue
                inverse = one / z
                u = ((m[0, 0] * fx + m[0, 1] * fy + m[0, 2]) * d + m[0, 3]) * inverse
                v = ((m[1, 0] * fx + m[1, 1] * fy + m[1, 2]) * d + m[1, 3]) * inverse
                if not (u > -half and u < width - half and v > -half and v < height - half):
                    continue
                left, top = int(np.floor(u)), int(np.floor(v))
                u0, v0 = max(left, 0), max(top, 0)
                u1, v1 = min(left + 1, width - 1), min(top + 1, height - 1)
                agrees, looks, says = False, True, False
                for yy in (v0, v1):
                    for xx in (u0, u1):
                        found = depth[other, yy, xx]
                        if found > 0:
                            says = True
                            ratio = z / found
                            agrees |= abs(ratio - one) < tolerance
                            looks &= ratio < most
                        else:
                            looks = False
                if not says:
                    continue
                weight = min(d * inverse, np.float32(HEAVIEST)) if weighted else one
                if agrees:
                    agree[view, y, x] += weight
                elif looks:
                    through[view, y, x] += weight
                else:
                    hidden[view, y, x] += weight
