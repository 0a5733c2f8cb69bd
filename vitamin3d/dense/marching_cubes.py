# SPDX-License-Identifier: Apache-2.0
"""Blocks of voxels -> the triangles of their zero level (Lorensen and Cline 1987).

A cube of eight voxels has a corner of the surface on each of its edges whose ends differ in sign. Which of these corners
are joined is decided face by face: where all four edges of a face are crossed, each of its two negative voxels is cut off
by itself, on both sides of the face alike, so that the surface has no holes.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.types import Array

SIDE = 8
"""Voxels along the side of a block."""
VOXELS = SIDE**3
MAX_TRIANGLES = 5
EMPTY = -1


@dataclass(frozen=True)
class Blocks:
    """Blocks of voxels; voxel x + 8 y + 64 z of a block lies at (8 key + (x, y, z)) voxel lengths."""

    keys: Array
    """(N, 3) int64."""
    near: Array
    """(N, 8) int64: the block itself and the ones after it along x, y, x and y, z, x and z, y and z, all; `EMPTY`: none."""
    distance: Array
    """(N, 512) float32, negative behind the surface."""
    weight: Array
    """(N, 512) float32."""
    shade: Array
    """(N, 512, C) float32: C channels of colour, 0 where there is none."""

    def in_order(self) -> Array:
        """(N,) int64: their numbers along x, then y, then z, so that what is near follows each other."""
        return np.lexsort(self.keys.T)


def _face_cycles() -> list[list[int]]:
    """The corners of each face of a cube, counter-clockwise as seen from outside; bits of a corner: x, y, z."""
    cycles = []
    for axis, side in product(range(3), range(2)):
        b, c = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        cycle = [side << axis | corner for corner in (0, b, b | c, c)]
        cycles.append(cycle if side else cycle[::-1])
    return cycles


def _edge(a: int, b: int) -> int:
    """An edge's number: three times its lower corner, plus its axis."""
    return 3 * min(a, b) + (a ^ b).bit_length() - 1


def _polygons(code: int) -> list[list[int]]:
    """Edges around each piece of the surface in a cube whose negative corners are the bits of `code`."""
    follows = {}
    for cycle in _face_cycles():
        signs = [code >> corner & 1 for corner in cycle]
        for k in range(4):
            if signs[k] and not signs[(k + 1) % 4]:  # leaves the negative corners that begin at j
                j = k
                while signs[j - 1]:
                    j -= 1
                follows[_edge(cycle[j - 1], cycle[j])] = _edge(cycle[k], cycle[(k + 1) % 4])
    polygons = []
    while follows:
        polygon = [min(follows)]
        while polygon[-1] in follows:
            polygon.append(follows.pop(polygon[-1]))
        polygons.append(polygon[:-1])
    return polygons


def _share_a_face(a: int, b: int) -> bool:
    """Whether two edges lie in one face of the cube."""
    corners = {a // 3, a // 3 | 1 << a % 3, b // 3, b // 3 | 1 << b % 3}
    return any(corners <= set(cycle) for cycle in _face_cycles())


def _fan(polygon: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a polygon around one of its corners, from which no diagonal lies in a face: the cube beside may have the same."""
    turned = [polygon[k:] + polygon[:k] for k in range(len(polygon))]
    around = min(turned, key=lambda p: sum(_share_a_face(p[0], other) for other in p[2:-1]))
    return [(around[0], around[k], around[k + 1]) for k in range(1, len(around) - 1)]


@cache
def triangle_table() -> tuple[Array, Array]:
    """How many triangles (256,) a cube with these negative corners has, and the edges (256, 5, 3) of their corners; int64."""
    count, edges = np.zeros(256, np.int64), np.zeros((256, MAX_TRIANGLES, 3), np.int64)
    for code in range(1, 255):
        for polygon in _polygons(code):
            for triangle in _fan(polygon):
                edges[code, count[code]] = triangle
                count[code] += 1
    return count, edges


@inlined
def reached(i, corner):  # type: ignore[no-untyped-def]
    """Which of the eight blocks holds a corner of the cube at voxel i, and its number there."""
    x, y, z = (i & 7) + (corner & 1), (i >> 3 & 7) + (corner >> 1 & 1), (i >> 6) + (corner >> 2)
    return x >> 3 | (y >> 3) << 1 | (z >> 3) << 2, (x & 7) | (y & 7) << 3 | (z & 7) << 6


@kernel
def signs(near, distance, weight, min_weight, negative, known):  # type: ignore[no-untyped-def]
    """Bits (9, 9) of the rows along x of a block and of the next voxels: where it is negative, and known."""
    for z in range(SIDE + 1):
        for y in range(SIDE + 1):
            which, at = (y >> 3) << 1 | (z >> 3) << 2, (y & 7) << 3 | (z & 7) << 6
            below, sure, b, next_b = 0, 0, near[which], near[which | 1]
            if b != EMPTY:
                for x in range(SIDE):
                    below |= (distance[b, at + x] < 0.0) << x
                    sure |= (weight[b, at + x] >= min_weight) << x
            if next_b != EMPTY:
                below |= (distance[next_b, at] < 0.0) << SIDE
                sure |= (weight[next_b, at] >= min_weight) << SIDE
            negative[z, y], known[z, y] = below, sure


@inlined
def _crossed(rows, z, y):  # type: ignore[no-untyped-def]
    """Bits of the cubes of a row that have both signs."""
    some = rows[z, y] | rows[z, y + 1] | rows[z + 1, y] | rows[z + 1, y + 1]
    every = rows[z, y] & rows[z, y + 1] & rows[z + 1, y] & rows[z + 1, y + 1]
    return (some | some >> 1) & ~(every & every >> 1)


@inlined
def known_cubes(rows, z, y):  # type: ignore[no-untyped-def]
    """Bits of the cubes of a row all of whose voxels are known."""
    every = rows[z, y] & rows[z, y + 1] & rows[z + 1, y] & rows[z + 1, y + 1]
    return every & every >> 1 & 0xFF


@inlined
def _code(rows, z, y, x):  # type: ignore[no-untyped-def]
    low = (rows[z, y] >> x & 3) | (rows[z, y + 1] >> x & 3) << 2
    return low | (rows[z + 1, y] >> x & 3) << 4 | (rows[z + 1, y + 1] >> x & 3) << 6


@kernel
def _find_cubes(near, distance, weight, min_weight, count, edges, codes, used):  # type: ignore[no-untyped-def]
    """Fills `codes` (N, 512) of the cubes with a piece of the surface, else 0, and `used` (N, 512), bits of the axes along which
    an edge begins at a voxel that holds a corner of the surface; the numbers of triangles and of corners."""
    negative, known = np.empty((SIDE + 1, SIDE + 1), np.int64), np.empty((SIDE + 1, SIDE + 1), np.int64)
    triangles, corners = 0, 0
    for b in range(near.shape[0]):
        signs(near[b], distance, weight, min_weight, negative, known)
        for z in range(SIDE):
            for y in range(SIDE):
                cubes = known_cubes(known, z, y) & _crossed(negative, z, y)
                x = 0
                while cubes >> x:
                    if cubes >> x & 1:
                        i, code = x | y << 3 | z << 6, _code(negative, z, y, x)
                        codes[b, i] = code
                        triangles += count[code]
                        for t in range(count[code]):
                            for k in range(3):
                                which, j = reached(i, edges[code, t, k] // 3)
                                bit, at = 1 << edges[code, t, k] % 3, near[b, which]
                                corners += (used[at, j] & bit) == 0
                                used[at, j] |= bit
                    x += 1
    return triangles, corners


@kernel
def _place_corners(order, keys, near, distance, shade, voxel, used, first, vertices, colors):  # type: ignore[no-untyped-def]
    """Corners of the surface, linear between voxels; `first` (N, 512) is the number of a voxel's first one."""
    n = 0
    for b in order:
        for i in range(VOXELS):
            first[b, i] = n
            if used[b, i] == 0:
                continue
            for axis in range(3):
                if not used[b, i] >> axis & 1:
                    continue
                which, j = reached(i, 1 << axis)
                at = near[b, which]
                here, there = np.float64(distance[b, i]), np.float64(distance[at, j])
                share = here / (here - there)
                x, y, z = np.float64(i & 7), np.float64(i >> 3 & 7), np.float64(i >> 6)
                vertices[n, 0] = (keys[b, 0] * SIDE + x + (share if axis == 0 else 0.0)) * voxel
                vertices[n, 1] = (keys[b, 1] * SIDE + y + (share if axis == 1 else 0.0)) * voxel
                vertices[n, 2] = (keys[b, 2] * SIDE + z + (share if axis == 2 else 0.0)) * voxel
                for c in range(shade.shape[2]):
                    colors[n, c] = (1.0 - share) * shade[b, i, c] + share * shade[at, j, c]
                n += 1


@kernel
def _join(order, near, codes, count, edges, used, first, triangles):  # type: ignore[no-untyped-def]
    n = 0
    for b in order:
        for i in range(VOXELS):
            code = codes[b, i]
            for t in range(count[code]):
                for k in range(3):
                    edge = edges[code, t, k]
                    which, j = reached(i, edge // 3)
                    at, v = near[b, which], 0
                    for axis in range(edge % 3):
                        v += used[at, j] >> axis & 1
                    triangles[n, k] = first[at, j] + v
                n += 1


def zero_level(blocks: Blocks, min_weight: float, voxel_length: float) -> tuple[Array, Array, Array]:
    """Vertices (V, 3) float64, triangles (F, 3) int32 facing the positive side, and colours (V, C) float32 of the surface.

    Only cubes whose voxels all have a weight of at least `min_weight` have a part in it. The order depends on places alone.
    """
    shape = blocks.distance.shape
    codes, used, first = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8), np.empty(shape, np.int32)
    count, edges = triangle_table()
    weights = (blocks.weight, np.float32(min_weight))
    num_triangles, num_vertices = _find_cubes(blocks.near, blocks.distance, *weights, count, edges, codes, used)
    vertices, colors = np.empty((num_vertices, 3)), np.empty((num_vertices, blocks.shade.shape[2]), np.float32)
    triangles, order = np.empty((num_triangles, 3), np.int32), blocks.in_order()
    _place_corners(order, blocks.keys, blocks.near, blocks.distance, blocks.shade, voxel_length, used, first, vertices, colors)
    _join(order, blocks.near, codes, count, edges, used, first, triangles)
    return vertices, triangles, colors
