# SPDX-License-Identifier: Apache-2.0
"""Which depths of a view its neighbours confirm or contradict: views vote, and those that agree know a depth better together."""

from dataclasses import replace

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView


@inlined
def _carry(depths, v, camera, T, height, place, far):  # type: ignore[no-untyped-def]
    """Of each pixel of row v the one of the other view that shows its point (-1: none), and the point's depth there.

    Without a branch, so that LLVM does several pixels at a time.
    """
    fx, fy, cx, cy = camera
    half, zero = np.float32(0.5), np.float32(0.0)
    y, width = (np.float32(v) - cy) / fy, depths.shape[0]
    for u in range(width):
        d = depths[u]
        a, b = (np.float32(u) - cx) / fx * d, y * d
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * d + T[2, 3]
        m = np.floor(fx * (T[0, 0] * a + T[0, 1] * b + T[0, 2] * d + T[0, 3]) / z + cx + half)
        n = np.floor(fy * (T[1, 0] * a + T[1, 1] * b + T[1, 2] * d + T[1, 3]) / z + cy + half)
        is_seen = (d > zero) & (z > zero) & (m >= zero) & (n >= zero) & (m < np.float32(width)) & (n < np.float32(height))
        place[u] = np.int32(n) * np.int32(width) + np.int32(m) if is_seen else np.int32(-1)
        far[u] = z


@kernel
def _compare(depth, other, T, camera, tolerance, confirmed, contradicted):  # type: ignore[no-untyped-def]
    """Adds one to `confirmed` (H, W) where the point lies on the other view's surface, within `tolerance` of its depth there,
    and to `contradicted` (H, W) where the other view has another depth. All numbers are float32."""
    height, width = depth.shape
    others, place, far = other.reshape(-1), np.empty(width, np.int32), np.empty(width, np.float32)
    for v in range(height):
        _carry(depth[v], v, camera, T, height, place, far)
        yes, no = confirmed[v], contradicted[v]
        for u in range(width):
            there = others[max(place[u], 0)]
            is_known = place[u] >= 0 and there > np.float32(0.0)
            agrees = abs(there - far[u]) < tolerance * far[u]
            yes[u] += is_known and agrees
            no[u] += is_known and not agrees


def compared(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float) -> tuple[Array, Array]:
    """How many (H, W) uint8 of the other views have the same depth, within `tolerance` of it, and how many have another."""
    confirmed, contradicted = np.zeros(view.depth.shape, np.uint8), np.zeros(view.depth.shape, np.uint8)
    camera = canvas.intrinsics.astype(np.float32)
    for other in others:
        T_other_view = np.ascontiguousarray(other.T_cam_world @ inverse(view.T_cam_world), np.float32)
        _compare(view.depth, other.depth, T_other_view, camera, np.float32(tolerance), confirmed, contradicted)
    return confirmed, contradicted


def voted(view: DepthView, others: list[DepthView], canvas: Camera, tolerance: float, contradicted_weight: float) -> DepthView:
    """The view with the weights of its pixels changed by the votes of others.

    Views that agree know the depth together: the weight is multiplied by their number, this view counted. Where more of the
    others contradict than confirm, it is multiplied by `contradicted_weight` instead.
    """
    if not others:
        return view
    confirmed, contradicted = compared(view, others, canvas, tolerance)
    weights = np.empty(view.weights.shape, np.float32)
    _reweigh(np.ascontiguousarray(view.weights, np.float32), confirmed, contradicted, np.float32(contradicted_weight), weights)
    return replace(view, weights=weights)


@kernel
def _reweigh(weights, confirmed, contradicted, contradicted_weight, out):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    for v in range(weights.shape[0]):
        for u in range(weights.shape[1]):
            factor = contradicted_weight if contradicted[v, u] > confirmed[v, u] else one + np.float32(confirmed[v, u])
            out[v, u] = weights[v, u] * factor
