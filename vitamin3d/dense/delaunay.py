# SPDX-License-Identifier: Apache-2.0
"""Landmarks of a keyframe -> a triangulation in the image (Sec. 4.2, "Meshing")."""

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from vitamin3d.config import DelaunayConfig
from vitamin3d.types import Array, ImageMesh, MapSnapshot


def triangulate(snapshot: MapSnapshot, config: DelaunayConfig) -> ImageMesh | None:
    """Delaunay triangulation of the snapshot's ideal pixels, with the inverse depth and the deviation of each vertex.

    Returns:
        None where fewer than `min_vertices` usable landmarks are left, or all of them lie on a line.
    """
    chosen = _usable(snapshot)
    chosen = chosen[_is_separate(snapshot.pixels[chosen], snapshot.relative_deviations[chosen], config.min_separation_px)]
    if len(chosen) < max(3, config.min_vertices):
        return None
    chosen = chosen[_strip_order(snapshot.pixels[chosen])]
    pixels = np.ascontiguousarray(snapshot.pixels[chosen], np.float64)
    try:
        triangles = Delaunay(pixels).simplices.astype(np.int32)
    except QhullError:
        return None
    deviation = np.hypot(snapshot.relative_deviations[chosen], config.deviation_floor)
    return ImageMesh(pixels, triangles, unique_edges(triangles), 1.0 / snapshot.depths[chosen], deviation)


def unique_edges(triangles: Array) -> Array:
    """Edges (E, 2) int32 of triangles (F, 3): each once, lower vertex first, in lexicographic order."""
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64), axis=1)
    stride = int(triangles.max()) + 1 if len(triangles) else 1
    keys = np.unique(pairs[:, 0] * stride + pairs[:, 1])
    return np.stack([keys // stride, keys % stride], axis=1).astype(np.int32)


def _usable(snapshot: MapSnapshot) -> Array:
    """Indices of the landmarks with a finite pixel, a positive depth and a deviation."""
    finite = np.isfinite(snapshot.pixels).all(axis=1) & np.isfinite(snapshot.depths) & np.isfinite(snapshot.relative_deviations)
    return np.flatnonzero(finite & (snapshot.depths > 0))


def _is_separate(pixels: Array, deviations: Array, distance_px: float) -> Array:
    """(N,) bool: False for the less certain landmark of each pair nearer than `distance_px`."""
    separate = np.ones(len(pixels), bool)
    if len(pixels) == 0:
        return separate
    order = np.argsort(deviations, kind="stable")
    pairs = cKDTree(pixels[order]).query_pairs(distance_px, output_type="ndarray")
    separate[order[pairs.max(axis=1)]] = False
    return separate


def _strip_order(pixels: Array, strip_px: float = 32.0) -> Array:
    """Order of the vertices along horizontal strips, so that neighbours in the image are neighbours in memory."""
    return np.lexsort((pixels[:, 0], np.floor(pixels[:, 1] / strip_px)))
