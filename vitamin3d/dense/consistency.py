# SPDX-License-Identifier: Apache-2.0
"""Which depths of a view its neighbours confirm or contradict: views vote, and those that agree know a depth better together."""

from dataclasses import replace

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView


@kernel
def _compare(depth, other, T, intrinsics, tolerance, confirmed, contradicted):  # type: ignore[no-untyped-def]
    """Adds one to `confirmed` (H, W) where the point lies on the other view's surface, within `tolerance` of its depth there,
    and to `contradicted` (H, W) where the other view has another depth."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    for v in range(height):
        for u in range(width):
            d = depth[v, u]
            if not d > 0.0:
                continue
            a, b = (u - cx) / fx * d, (v - cy) / fy * d
            z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * d + T[2, 3]
            if z <= 0.0:
                continue
            x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * d + T[0, 3]
            y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * d + T[1, 3]
            m, n = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
            if 0 <= m < width and 0 <= n < height and other[n, m] > 0.0:
                if abs(other[n, m] - z) < tolerance * z:
                    confirmed[v, u] += 1
                else:
                    contradicted[v, u] += 1


def compared(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float) -> tuple[Array, Array]:
    """How many (H, W) uint8 of the other views have the same depth, within `tolerance` of it, and how many have another."""
    confirmed, contradicted = np.zeros(view.depth.shape, np.uint8), np.zeros(view.depth.shape, np.uint8)
    for other in others:
        T_other_view = np.ascontiguousarray(other.T_cam_world @ inverse(view.T_cam_world))
        _compare(view.depth, other.depth, T_other_view, canvas.intrinsics, tolerance, confirmed, contradicted)
    return confirmed, contradicted


def voted(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float, contradicted_weight: float) -> DepthView:
    """The view with the weights of its pixels changed by the votes of others.

    Views that agree know the depth together: the weight is multiplied by their number, this view counted. Where more of the
    others contradict than confirm, it is multiplied by `contradicted_weight` instead.
    """
    if not others:
        return view
    confirmed, contradicted = compared(view, others, canvas, tolerance)
    factors = np.where(contradicted > confirmed, np.float32(contradicted_weight), np.float32(1.0) + confirmed.astype(np.float32))
    return replace(view, weights=view.weights * factors)
