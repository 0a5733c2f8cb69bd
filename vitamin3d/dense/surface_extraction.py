# SPDX-License-Identifier: Apache-2.0
"""The mesh that leaves the volume: without crumbs, with normals."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vitamin3d.config import SurfaceConfig
from vitamin3d.types import Array, Surface


def clean(surface: Surface, config: SurfaceConfig) -> Surface:
    """The surface without small connected pieces and unreferenced vertices, with vertex normals on the triangles' front side."""
    triangles = surface.triangles[_has_area(surface)]
    kept = triangles[component_sizes(triangles, len(surface.vertices_world)) >= config.min_component_triangles]
    used, renumbered = np.unique(kept, return_inverse=True)
    faces = renumbered.reshape(-1, 3).astype(np.int32)
    vertices = surface.vertices_world[used]
    return Surface(vertices, faces, vertex_normals(vertices, faces), surface.colors[used])


def component_sizes(triangles: Array, num_vertices: int) -> Array:
    """(F,) number of triangles in the connected piece (through shared vertices) of each triangle."""
    if len(triangles) == 0:
        return np.zeros(0, np.int64)
    rows, columns = np.concatenate([triangles[:, 0], triangles[:, 1]]), np.concatenate([triangles[:, 1], triangles[:, 2]])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(num_vertices, num_vertices))
    labels = connected_components(graph, directed=False)[1][triangles[:, 0]]
    return np.asarray(np.bincount(labels)[labels])


def vertex_normals(vertices: Array, triangles: Array) -> Array:
    """Unit normals (V, 3): the sum of the normals of the vertex's triangles, weighted by area; zero without triangles."""
    summed = _corner_sums(_scaled_normals(vertices, triangles), triangles, len(vertices))
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(np.divide(summed, length, out=np.zeros_like(summed), where=length > 0))


def _scaled_normals(vertices: Array, triangles: Array) -> Array:
    """(F, 3) normals with the length of twice the area, on the side from which the corners run counter-clockwise."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _corner_sums(values: Array, triangles: Array, count: int) -> Array:
    """(count, 3) sums of the triangles' values (F, 3) over the triangles around each vertex."""
    corners = triangles.ravel()
    return np.stack([np.bincount(corners, np.repeat(values[:, k], 3), count) for k in range(3)], axis=1).astype(np.float64)


def _has_area(surface: Surface) -> Array:
    """(F,) bool: not collapsed to a line or a point."""
    a, b, c = (surface.triangles[:, k] for k in range(3))
    is_proper = (a != b) & (b != c) & (c != a)
    return np.asarray(is_proper & (_scaled_normals(surface.vertices_world, surface.triangles) != 0).any(axis=1))
