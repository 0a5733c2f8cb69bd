# SPDX-License-Identifier: Apache-2.0
"""Triangulation of points from two views: linear, with parallax, cheirality and reprojection error."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.types import Array


@kernel
def _triangulate(rays_a, rays_b, T_b_a, points_a, cos_parallax):  # type: ignore[no-untyped-def]
    """Least squares for the depths of two rays that should meet; the point is the middle of the shortest segment.

    rays (N, 3) with z = 1, T_b_a (N, 4, 4). NaN where the rays are parallel.
    """
    for i in range(rays_a.shape[0]):
        R, t = T_b_a[i, :3, :3], T_b_a[i, :3, 3]
        d0 = R[0, 0] * rays_a[i, 0] + R[0, 1] * rays_a[i, 1] + R[0, 2]
        d1 = R[1, 0] * rays_a[i, 0] + R[1, 1] * rays_a[i, 1] + R[1, 2]
        d2 = R[2, 0] * rays_a[i, 0] + R[2, 1] * rays_a[i, 1] + R[2, 2]
        e0, e1 = rays_b[i, 0], rays_b[i, 1]
        dd, ee, de = d0 * d0 + d1 * d1 + d2 * d2, e0 * e0 + e1 * e1 + 1.0, d0 * e0 + d1 * e1 + d2
        dt, et = d0 * t[0] + d1 * t[1] + d2 * t[2], e0 * t[0] + e1 * t[1] + t[2]
        det = dd * ee - de * de
        cos_parallax[i] = min(1.0, de / np.sqrt(dd * ee))
        if det <= 1e-14 * dd * ee:
            points_a[i, :] = np.nan
            continue
        a = (de * et - ee * dt) / det
        b = (dd * et - de * dt) / det
        m0 = 0.5 * (a * d0 + t[0] + b * e0) - t[0]
        m1 = 0.5 * (a * d1 + t[1] + b * e1) - t[1]
        m2 = 0.5 * (a * d2 + t[2] + b) - t[2]
        for k in range(3):
            points_a[i, k] = R[0, k] * m0 + R[1, k] * m1 + R[2, k] * m2


def triangulate(rays_a: Array, rays_b: Array, T_b_a: Array) -> tuple[Array, Array]:
    """Points seen along two rays each.

    Args:
        rays_a: (N, 3) with z = 1, in frame a.
        rays_b: (N, 3) with z = 1, in frame b.
        T_b_a: (4, 4) or (N, 4, 4).

    Returns:
        points in frame a (N, 3), NaN for parallel rays; and the parallax, the angle between the rays, (N,) degrees.
    """
    points, cosine = np.empty((len(rays_a), 3)), np.empty(len(rays_a))
    transforms = np.ascontiguousarray(np.broadcast_to(T_b_a, (len(rays_a), 4, 4)))
    _triangulate(np.ascontiguousarray(rays_a), np.ascontiguousarray(rays_b), transforms, points, cosine)
    return points, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
