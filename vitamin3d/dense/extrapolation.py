# SPDX-License-Identifier: Apache-2.0
"""Vertices on the border of the picture, where no landmark is: the planes of the mesh continued (not in the paper).

The convex hull of the landmarks ends before the picture does, in slivers; what only the edges of a few pictures show would
be lost. The votes of other views (`consistency.py`) decide what of it is fused.
"""

from dataclasses import replace

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import ExtrapolationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.planar_delaunay import delaunay
from vitamin3d.types import Array, ImageMesh


def outline(camera: Camera, spacing_px: float) -> Array:
    """Ideal pixels (N, 2) along the border of the camera's picture, about `spacing_px` apart."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    us, vs = (np.linspace(0.0, end, max(2, round(end / spacing_px) + 1)) for end in (right, bottom))
    sides = ((us, 0.0), (us, bottom), (0.0, vs[1:-1]), (right, vs[1:-1]))
    pixels = camera.undistort(np.concatenate([np.stack(np.broadcast_arrays(u, v), -1) for u, v in sides]))
    return np.asarray(pixels[np.isfinite(pixels).all(axis=1)])


@kernel
def _nearest(points, queries, squared, near):  # type: ignore[no-untyped-def]
    """Fills `squared` (Q, K), which comes infinite, and `near` (Q, K) by insertion; of equal ones the first comes first."""
    count = near.shape[1]
    for q in range(queries.shape[0]):
        for p in range(points.shape[0]):
            x, y = points[p, 0] - queries[q, 0], points[p, 1] - queries[q, 1]
            d, k = x * x + y * y, count - 1
            if d < squared[q, k]:
                while k > 0 and d < squared[q, k - 1]:
                    squared[q, k], near[q, k] = squared[q, k - 1], near[q, k - 1]
                    k -= 1
                squared[q, k], near[q, k] = d, p


def nearest(points: Array, queries: Array, count: int) -> tuple[Array, Array]:
    """Distances and indices (Q, count) of the nearest of points (N, 2), N >= count, the nearest first; for few queries."""
    squared, near = np.full((len(queries), count), np.inf), np.zeros((len(queries), count), np.int64)
    _nearest(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(queries, np.float64), squared, near)
    return np.sqrt(squared), near


def extended(mesh: ImageMesh, slopes: Array, border: Array, config: ExtrapolationConfig) -> tuple[ImageMesh, Array]:
    """A denoised mesh and its slopes (V, 2), triangulated anew with vertices at the pixels `border` (N, 2).

    The inverse depth of a new vertex is the median of what the planes of the nearest vertices say there; none comes where
    that is far from the inverse depths of these vertices. Its deviation is their median and grows with the distance.
    """
    count = min(config.neighbours, len(mesh.pixels))
    distance, near = nearest(mesh.pixels, border, count)
    around = mesh.inverse_depth[near]
    continued = np.median(around + ((border[:, None] - mesh.pixels[near]) * slopes[near]).sum(axis=2), axis=1)
    low, high = around.min(axis=1) / config.max_ratio, around.max(axis=1) * config.max_ratio
    good = (continued > low) & (continued < high) & (distance[:, 0] > config.min_distance_px)
    pixels = np.concatenate([mesh.pixels, border[good]])
    triangles, edges = delaunay(pixels)
    deviations = np.median(mesh.relative_deviation[near], axis=1) * (1.0 + distance[:, 0] / config.doubling_px)
    whole = replace(
        mesh,
        pixels=pixels,
        triangles=triangles,
        edges=edges,
        inverse_depth=np.concatenate([mesh.inverse_depth, continued[good]]),
        relative_deviation=np.concatenate([mesh.relative_deviation, deviations[good]]),
    )
    return whole, np.concatenate([slopes, np.median(slopes[near], axis=1)[good]])
