# SPDX-License-Identifier: Apache-2.0
"""Landmarks of a keyframe -> a triangulation in the image (Sec. 4.2, "Meshing")."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import DelaunayConfig
from vitamin3d.geometry.cells import cell_number, cells_of
from vitamin3d.geometry.planar_delaunay import delaunay
from vitamin3d.types import Array, ImageMesh, MapSnapshot

VERTICES_PER_CELL = 2.0


def triangulate(snapshot: MapSnapshot, config: DelaunayConfig) -> ImageMesh | None:
    """Delaunay triangulation of the snapshot's ideal pixels, with the inverse depth and the deviation of each vertex.

    Returns:
        None where fewer than `min_vertices` usable landmarks are left, or all of them lie on a line.
    """
    chosen = _usable(snapshot)
    chosen = chosen[separate_in_order(snapshot.pixels[chosen], snapshot.relative_deviations[chosen], config.min_separation_px)]
    if len(chosen) < max(3, config.min_vertices):
        return None
    pixels = np.ascontiguousarray(snapshot.pixels[chosen], np.float64)
    triangles, edges = delaunay(pixels)
    if not len(triangles):
        return None
    deviation = np.hypot(snapshot.relative_deviations[chosen], config.deviation_floor)
    return ImageMesh(pixels, triangles, edges, 1.0 / snapshot.depths[chosen], deviation)


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


@kernel
def _mark_close(pixels, deviations, order, starts, columns, rows, distance, is_separate):  # type: ignore[no-untyped-def]
    """Each point against those of its cell and of the next ones, which are at least `distance` wide."""
    for row in range(rows):
        for column in range(columns):
            cell = cell_number(column, row, columns)
            for v in range(row, min(row + 2, rows)):
                for u in range(max(column - 1, 0) if v > row else column, min(column + 2, columns)):
                    other = cell_number(u, v, columns)
                    for m in range(starts[cell], starts[cell + 1]):
                        for n in range(m + 1 if other == cell else starts[other], starts[other + 1]):
                            i, j = order[m], order[n]
                            x, y = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
                            if x * x + y * y <= distance * distance:
                                is_first = deviations[i] < deviations[j] or (deviations[i] == deviations[j] and i < j)
                                is_separate[j if is_first else i] = False


def separate_in_order(pixels: Array, deviations: Array, distance_px: float) -> Array:
    """Indices of pixels (N, 2) without the less certain one of each pair within `distance_px` (of equal ones the later one).

    They come row by row of a grid of cells, so that neighbours in the image are neighbours in memory.
    """
    if len(pixels) == 0:
        return np.zeros(0, np.int64)
    pixels = np.ascontiguousarray(pixels, np.float64)
    cells, is_separate = cells_of(pixels, VERTICES_PER_CELL, distance_px), np.ones(len(pixels), np.bool_)
    _mark_close(pixels, np.asarray(deviations, np.float64), cells.order, cells.starts, cells.columns, cells.rows, distance_px, is_separate)
    return np.asarray(cells.order[is_separate[cells.order]])
