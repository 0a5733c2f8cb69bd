# SPDX-License-Identifier: Apache-2.0
"""Delaunay triangulation of points in the plane: insertion one by one, edges flipped (Lawson 1977), ties left as they come.

Points are put on a grid of 2²⁵ steps across them; there both predicates are exact: the orientation of three points in
float64, the circle through three in float64 where its rounding cannot matter and in integers elsewhere. So every result is
the triangulation of the points on the grid (for a picture of 1,000 pixels, within 2⁻¹⁶ pixels of the given ones), on every machine.

The plane is closed by triangles between the edges of the convex hull and one vertex at infinity, so that points outside
are inserted like those inside. Halfedge h = 3 f + k of triangle f leads from `corners[h]` to the next corner; `twins[h]` is the
one that leads back.
"""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.cells import bounds, cells_of
from vitamin3d.types import Array

GRID_BITS = 25
POINTS_PER_CELL = 2.0
ROUNDS_STEP = 4
"""Each round of insertion has about so many times the points of all before it."""


@inlined
def _turn(x, y, a, b, c):  # type: ignore[no-untyped-def]
    """Twice the signed area of a triangle, exact."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


@inlined
def _is_in_circle(x, y, a, b, c, p):  # type: ignore[no-untyped-def]
    """Whether p lies inside the circle through a, b, c, which run counter-clockwise; False on it."""
    ax, ay, bx, by, cx, cy = x[a] - x[p], y[a] - y[p], x[b] - x[p], y[b] - y[p], x[c] - x[p], y[c] - y[p]
    a2, b2, c2 = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    bc, ca, ab = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    determinant = a2 * bc + b2 * ca + c2 * ab
    if abs(determinant) > 1e-15 * (a2 * abs(bc) + b2 * abs(ca) + c2 * abs(ab)):
        return determinant > 0.0
    low, middle, high = _product_parts(a2, bc)
    more = _product_parts(b2, ca)
    low, middle, high = low + more[0], middle + more[1], high + more[2]
    more = _product_parts(c2, ab)
    low, middle, high = low + more[0], middle + more[1], high + more[2]
    middle += low >> 26
    high += middle >> 26
    return high > 0 or (high == 0 and ((middle & 0x3FFFFFF) > 0 or (low & 0x3FFFFFF) > 0))


@inlined
def _product_parts(a, b):  # type: ignore[no-untyped-def]
    """The product of two whole numbers below 2⁵² in magnitude as three int64: low + 2²⁶ middle + 2⁵² high."""
    m, n = np.int64(a), np.int64(b)
    m1, m0, n1, n0 = m >> 26, m & 0x3FFFFFF, n >> 26, n & 0x3FFFFFF
    return m0 * n0, m1 * n0 + m0 * n1, m1 * n1


@inlined
def _is_outside(x, y, a, b, p):  # type: ignore[no-untyped-def]
    """Whether p lies to the left of the line from a to b, or between the two."""
    turn = _turn(x, y, a, b, p)
    return turn > 0.0 or (turn == 0.0 and (x[p] - x[a]) * (x[p] - x[b]) + (y[p] - y[a]) * (y[p] - y[b]) < 0.0)


@inlined
def _is_in_conflict(x, y, a, b, c, p):  # type: ignore[no-untyped-def]
    """Whether the circle through a, b, c holds p; that through the vertex at infinity is a half-plane."""
    infinite = x.shape[0]
    if a == infinite:
        return _is_outside(x, y, b, c, p)
    if b == infinite:
        return _is_outside(x, y, c, a, p)
    if c == infinite:
        return _is_outside(x, y, a, b, p)
    return _is_in_circle(x, y, a, b, c, p)


@inlined
def _join(twins, g, h):  # type: ignore[no-untyped-def]
    twins[g], twins[h] = h, g


@inlined
def _next(h):  # type: ignore[no-untyped-def]
    return h - 2 if h % 3 == 2 else h + 1


@kernel
def _first_triangle(x, y, order, corners, twins):  # type: ignore[no-untyped-def]
    """The first three points that are not on a line, and three triangles outside; whether there are any."""
    infinite, a, b, c = x.shape[0], order[0], -1, -1
    for p in order:
        if b < 0:
            if x[p] != x[a] or y[p] != y[a]:
                b = p
        elif _turn(x, y, a, b, p) != 0.0:
            c = p
            break
    if c < 0:
        return False
    if _turn(x, y, a, b, c) < 0.0:
        b, c = c, b
    corners[0], corners[1], corners[2] = a, b, c
    for k in range(3):
        h = 3 * (k + 1)
        corners[h], corners[h + 1], corners[h + 2] = corners[(k + 1) % 3], corners[k], infinite
        _join(twins, k, h)
        _join(twins, h + 1, 3 * ((k + 2) % 3 + 1) + 2)
    return True


@inlined
def _located(x, y, corners, twins, p, at):  # type: ignore[no-untyped-def]
    """The triangle that holds p, or one beyond an edge of the hull that p sees; `at` is a triangle to start from."""
    infinite = x.shape[0]
    for k in range(3):
        if corners[3 * at + k] == infinite:
            at = twins[3 * at + (k + 1) % 3] // 3  # across the finite edge
            break
    k = 0
    while k < 3:
        h = 3 * at + k
        if _turn(x, y, corners[h], corners[_next(h)], p) < 0.0:
            at, k = twins[h] // 3, 0
            if corners[3 * at] == infinite or corners[3 * at + 1] == infinite or corners[3 * at + 2] == infinite:
                return at
        else:
            k += 1
    return at


@inlined
def _split(corners, twins, f, p, count, stack):  # type: ignore[no-untyped-def]
    """Triangle f becomes three around p, the other two with numbers from `count` on; the halfedges opposite p go on the stack."""
    a, b, c = corners[3 * f], corners[3 * f + 1], corners[3 * f + 2]
    g, h = 3 * count, 3 * count + 3
    f = 3 * f
    beyond_b, beyond_c = twins[f + 1], twins[f + 2]
    corners[f + 2] = p
    corners[g], corners[g + 1], corners[g + 2] = b, c, p
    corners[h], corners[h + 1], corners[h + 2] = c, a, p
    _join(twins, g, beyond_b)
    _join(twins, h, beyond_c)
    _join(twins, f + 1, g + 2)
    _join(twins, g + 1, h + 2)
    _join(twins, h + 1, f + 2)
    stack[0], stack[1], stack[2] = f, g, h


@inlined
def _flip(corners, twins, f):  # type: ignore[no-untyped-def]
    """The edge of halfedge f, opposite p, is replaced by one from p; the other triangle's first halfedge, opposite p too."""
    t = twins[f]
    g = 3 * (t // 3)
    a, b, p, d = corners[f], corners[f + 1], corners[f + 2], corners[_next(_next(t))]
    beyond_ad, beyond_db, beyond_pa = twins[_next(t)], twins[_next(_next(t))], twins[f + 2]
    corners[f], corners[f + 1], corners[f + 2] = d, b, p
    corners[g], corners[g + 1], corners[g + 2] = a, d, p
    _join(twins, f, beyond_db)
    _join(twins, g, beyond_ad)
    _join(twins, g + 2, beyond_pa)
    _join(twins, f + 2, g + 1)
    return g


@kernel
def _insert_all(x, y, order, corners, twins, stack):  # type: ignore[no-untyped-def]
    """Inserts the points in the given order, after the first triangle; the number of triangles."""
    count, at = 4, 0
    for p in order:
        at = _located(x, y, corners, twins, p, at)
        is_new = True
        for k in range(3):
            v = corners[3 * at + k]
            is_new &= v == x.shape[0] or x[v] != x[p] or y[v] != y[p]
        if not is_new:
            continue
        _split(corners, twins, at, p, count, stack)
        count, top = count + 2, 3
        while top > 0:
            top -= 1
            f = stack[top]
            t = twins[f]
            if _is_in_conflict(x, y, corners[t], corners[_next(t)], corners[_next(_next(t))], p):
                g = _flip(corners, twins, f)
                stack[top], stack[top + 1] = f, g
                top += 2
    return count


@kernel
def _collect(corners, count, infinite, triangles, starts, edges):  # type: ignore[no-untyped-def]
    """The finite triangles, and each edge once, sorted; how many there are of both. `starts` (V + 1,) zeros."""
    num_triangles, num_edges = 0, 0
    for f in range(count):
        a, b, c = corners[3 * f], corners[3 * f + 1], corners[3 * f + 2]
        if a != infinite and b != infinite and c != infinite:
            triangles[num_triangles, 0], triangles[num_triangles, 1], triangles[num_triangles, 2] = a, b, c
            num_triangles += 1
    for h in range(3 * count):
        a, b = corners[h], corners[_next(h)]
        if a < b and b != infinite:
            starts[a + 1] += 1
            num_edges += 1
    for v in range(infinite):
        starts[v + 1] += starts[v]
    for h in range(3 * count):
        a, b = corners[h], corners[_next(h)]
        if a < b and b != infinite:
            edges[starts[a], 0], edges[starts[a], 1] = a, b
            starts[a] += 1
    for e in range(1, num_edges):
        a, b, k = edges[e, 0], edges[e, 1], e - 1
        while k >= 0 and edges[k, 0] == a and edges[k, 1] > b:
            edges[k + 1, 1] = edges[k, 1]
            k -= 1
        edges[k + 1, 1] = b
    return num_triangles, num_edges


def delaunay(points: Array) -> tuple[Array, Array]:
    """Delaunay triangulation of points (N, 2), finite.

    Returns:
        Triangles (F, 3) int32, counter-clockwise where y points up, and their edges (E, 2) int32: each once, lower vertex
        first, in lexicographic order. Points that fall on an earlier one of the grid are corners of no triangle; where all
        points lie on a line there are none.
    """
    count = len(points)
    if count < 3:
        return _nothing()
    corner, size = bounds(points)
    extent = max(size)
    if extent <= 0.0:
        return _nothing()
    scale = 2.0 ** (GRID_BITS - 1 - np.floor(np.log2(extent)))
    x, y = np.ascontiguousarray(np.rint((points - corner) * scale).T)
    order = _insertion_order(x, y)
    corners, twins = np.empty(6 * count, np.int32), np.empty(6 * count, np.int32)
    if not _first_triangle(x, y, order, corners, twins):
        return _nothing()
    num = _insert_all(x, y, order, corners, twins, np.empty(4 * count, np.int32))
    triangles, edges = np.empty((2 * count, 3), np.int32), np.empty((3 * count, 2), np.int32)
    num_triangles, num_edges = _collect(corners, num, count, triangles, np.zeros(count + 1, np.int64), edges)
    return triangles[:num_triangles].copy(), edges[:num_edges].copy()


def _nothing() -> tuple[Array, Array]:
    return np.zeros((0, 3), np.int32), np.zeros((0, 2), np.int32)


def _insertion_order(x: Array, y: Array) -> Array:
    """Rounds that each spread over all points; in a round neighbours come one after the other."""
    order = cells_of(np.column_stack([x, y]), POINTS_PER_CELL).order
    stride = ROUNDS_STEP ** int(np.log(len(x)) / np.log(ROUNDS_STEP))
    rounds = [order[::stride]]
    while stride > 1:
        stride //= ROUNDS_STEP
        finer = order[::stride]
        rounds.append(finer[np.arange(len(finer)) % ROUNDS_STEP != 0])
    return np.concatenate(rounds)
