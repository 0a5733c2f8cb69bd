# SPDX-License-Identifier: Apache-2.0
"""Which depths of a view its neighbours confirm or contradict: what is contradicted alone is believed less."""

from dataclasses import replace

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView


@kernel
def _compare(depth, other, T, intrinsics, tolerance, confirmed, contradicted):  # type: ignore[no-untyped-def]
    """Sets `confirmed` (H, W) where the point lies on the other view's surface, within `tolerance` of its depth there,
    and `contradicted` (H, W) where the other view has another depth."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    for v in range(height):
        for u in range(width):
            d = depth[v, u]
            if confirmed[v, u] or not d > 0.0:
                continue
            a, b = (u - cx) / fx * d, (v - cy) / fy * d
            z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * d + T[2, 3]
            if z <= 0.0:
                continue
            x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * d + T[0, 3]
            y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * d + T[1, 3]
            m, n = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
            if 0 <= m < width and 0 <= n < height and other[n, m] > 0.0:
                agrees = abs(other[n, m] - z) < tolerance * z
                confirmed[v, u] |= agrees
                contradicted[v, u] |= not agrees


def compared(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float) -> tuple[Array, Array]:
    """Where (H, W) bool another view has the same depth, within `tolerance` of it, and where one has another.

    The second is complete only where the first is False: who is confirmed is not asked again.
    """
    confirmed, contradicted = np.zeros(view.depth.shape, np.bool_), np.zeros(view.depth.shape, np.bool_)
    for other in others:
        T_other_view = np.ascontiguousarray(other.T_cam_world @ inverse(view.T_cam_world))
        _compare(view.depth, other.depth, T_other_view, canvas.intrinsics, tolerance, confirmed, contradicted)
    return confirmed, contradicted


def doubted(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float, factor: float) -> DepthView:
    """The view with the weights of the pixels that others contradict and none confirms multiplied by `factor`."""
    if not others:
        return view
    confirmed, contradicted = compared(view, others, canvas, tolerance)
    factors = np.where(contradicted & ~confirmed, np.float32(factor), np.float32(1.0))
    return replace(view, weights=view.weights * factors)
