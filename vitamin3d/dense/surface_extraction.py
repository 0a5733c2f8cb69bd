# SPDX-License-Identifier: Apache-2.0
"""The mesh that leaves the volume: without crumbs, with normals."""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.config import SurfaceConfig
from vitamin3d.types import Array, Surface


def clean(surface: Surface, config: SurfaceConfig) -> Surface:
    """The surface without small connected pieces and unreferenced vertices, with vertex normals on the triangles' front side."""
    triangles = np.compress(_has_area(surface.vertices_world, surface.triangles), surface.triangles, axis=0)  # 4× faster than a mask
    sizes = component_sizes(triangles, len(surface.vertices_world))
    kept = np.compress(sizes >= config.min_component_triangles, triangles, axis=0)
    number = np.full(len(surface.vertices_world), -1, np.int32)
    _mark(kept, number)
    used = np.flatnonzero(number == 0)
    number[used] = np.arange(len(used), dtype=np.int32)
    vertices, faces = surface.vertices_world.take(used, axis=0), number.take(kept)
    return Surface(vertices, faces, vertex_normals(vertices, faces), surface.colors.take(used, axis=0))


def component_sizes(triangles: Array, num_vertices: int) -> Array:
    """(F,) number of triangles in the connected piece (through shared vertices) of each triangle."""
    sizes = np.empty(len(triangles), np.int64)
    _count_connected(_as_int32(triangles), np.arange(num_vertices, dtype=np.int32), np.zeros(num_vertices, np.int64), sizes)
    return sizes


def vertex_normals(vertices: Array, triangles: Array) -> Array:
    """Unit normals (V, 3): the sum of the normals of the vertex's triangles, weighted by area; zero without triangles."""
    normals = np.zeros((len(vertices), 3))
    _add_normals(np.ascontiguousarray(vertices, np.float64), _as_int32(triangles), normals)
    return normals


def _has_area(vertices: Array, triangles: Array) -> Array:
    """(F,) bool: not collapsed to a line or a point."""
    has_area = np.empty(len(triangles), np.bool_)
    _check_area(np.ascontiguousarray(vertices, np.float64), _as_int32(triangles), has_area)
    return has_area


def _as_int32(triangles: Array) -> Array:
    return np.ascontiguousarray(triangles, np.int32)


@kernel
def _mark(triangles, number):  # type: ignore[no-untyped-def]
    """Sets the corners' numbers (V,) to 0."""
    for f in range(triangles.shape[0]):
        for k in range(3):
            number[triangles[f, k]] = 0


@inlined
def _root(parents, v):  # type: ignore[no-untyped-def]
    """The first of a piece; the way there becomes shorter."""
    while parents[v] != v:
        parents[v] = parents[parents[v]]
        v = parents[v]
    return v


@kernel
def _count_connected(triangles, parents, counts, sizes):  # type: ignore[no-untyped-def]
    """`parents` (V,) come as each its own, `counts` (V,) as 0."""
    for f in range(triangles.shape[0]):
        a, b, c = _root(parents, triangles[f, 0]), _root(parents, triangles[f, 1]), _root(parents, triangles[f, 2])
        first = min(a, min(b, c))
        parents[a], parents[b], parents[c] = first, first, first
    for v in range(parents.shape[0]):
        parents[v] = parents[parents[v]]  # the parent has the smaller number: its own is the first of the piece already
    for f in range(triangles.shape[0]):
        counts[parents[triangles[f, 0]]] += 1
    for f in range(triangles.shape[0]):
        sizes[f] = counts[parents[triangles[f, 0]]]


@inlined
def _scaled_normal(vertices, a, b, c):  # type: ignore[no-untyped-def]
    """A normal as long as twice the area, on the side from which the corners run counter-clockwise."""
    px, py, pz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    qx, qy, qz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx


@kernel
def _check_area(vertices, triangles, has_area):  # type: ignore[no-untyped-def]
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        x, y, z = _scaled_normal(vertices, a, b, c)
        has_area[f] = a != b and b != c and c != a and (x != 0.0 or y != 0.0 or z != 0.0)


@kernel
def _add_normals(vertices, triangles, normals):  # type: ignore[no-untyped-def]
    """`normals` (V, 3) come as 0."""
    for f in range(triangles.shape[0]):
        x, y, z = _scaled_normal(vertices, triangles[f, 0], triangles[f, 1], triangles[f, 2])
        for k in range(3):
            v = triangles[f, k]
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for v in range(normals.shape[0]):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if length > 0.0:
            for k in range(3):
                normals[v, k] /= length
