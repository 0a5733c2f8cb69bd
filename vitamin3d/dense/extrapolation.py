# SPDX-License-Identifier: Apache-2.0
"""Vertices on the border of the picture, where no landmark is: the planes of the mesh continued (not in the paper).

The convex hull of the landmarks ends before the picture does, in slivers; what only the edges of a few pictures show would
be lost. The votes of other views (`consistency.py`) decide what of it is fused.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from vitamin3d.config import ExtrapolationConfig
from vitamin3d.dense.delaunay import unique_edges
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array, ImageMesh


def outline(camera: Camera, spacing_px: float) -> Array:
    """Ideal pixels (N, 2) along the border of the camera's picture, about `spacing_px` apart."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    us, vs = (np.linspace(0.0, end, max(2, round(end / spacing_px) + 1)) for end in (right, bottom))
    sides = ((us, 0.0), (us, bottom), (0.0, vs[1:-1]), (right, vs[1:-1]))
    pixels = camera.undistort(np.concatenate([np.stack(np.broadcast_arrays(u, v), -1) for u, v in sides]))
    return np.asarray(pixels[np.isfinite(pixels).all(axis=1)])


def extended(mesh: ImageMesh, slopes: Array, border: Array, config: ExtrapolationConfig) -> tuple[ImageMesh, Array]:
    """A denoised mesh and its slopes (V, 2), triangulated anew with vertices at the pixels `border` (N, 2).

    The inverse depth of a new vertex is the median of what the planes of the nearest vertices say there; none comes where
    that is far from the inverse depths of these vertices. Its deviation is their median and grows with the distance.
    """
    count = min(config.neighbours, len(mesh.pixels))
    distance, near = cKDTree(mesh.pixels).query(border, k=count)
    distance, near = distance.reshape(len(border), count), near.reshape(len(border), count)
    around = mesh.inverse_depth[near]
    continued = np.median(around + ((border[:, None] - mesh.pixels[near]) * slopes[near]).sum(axis=2), axis=1)
    low, high = around.min(axis=1) / config.max_ratio, around.max(axis=1) * config.max_ratio
    good = (continued > low) & (continued < high) & (distance[:, 0] > config.min_distance_px)
    pixels = np.concatenate([mesh.pixels, border[good]])
    try:
        triangles = Delaunay(pixels).simplices.astype(np.int32)
    except QhullError:
        return mesh, slopes
    deviations = np.median(mesh.relative_deviation[near], axis=1) * (1.0 + distance[:, 0] / config.doubling_px)
    whole = replace(
        mesh,
        pixels=pixels,
        triangles=triangles,
        edges=unique_edges(triangles),
        inverse_depth=np.concatenate([mesh.inverse_depth, continued[good]]),
        relative_deviation=np.concatenate([mesh.relative_deviation, deviations[good]]),
    )
    return whole, np.concatenate([slopes, np.median(slopes[near], axis=1)[good]])
