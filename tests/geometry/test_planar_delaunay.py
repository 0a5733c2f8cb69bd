# SPDX-License-Identifier: Apache-2.0
"""The triangulation against exact arithmetic, against scipy's, and on what has no triangulation of its own."""

import numpy as np
import pytest
import reference_dense as reference
from scipy.spatial import ConvexHull, Delaunay

from vitamin3d.geometry.planar_delaunay import _is_in_circle, _product_parts, delaunay


def doubled_area(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def same_triangles(one, other):
    return {tuple(sorted(t)) for t in one.tolist()} == {tuple(sorted(t)) for t in other.tolist()}


def is_in_circle(a, b, c, p, number=int):
    """Whether the determinant is positive, as where p lies inside the circle through a, b, c: exact for integers."""
    rows = [[number(x - u) for x, u in zip(q, p, strict=True)] for q in (a, b, c)]
    (ax, ay), (bx, by), (cx, cy) = rows
    squares = [x * x + y * y for x, y in rows]
    return squares[0] * (bx * cy - by * cx) + squares[1] * (cx * ay - cy * ax) + squares[2] * (ax * by - ay * bx) > 0


def check(points, triangles, edges):
    """A triangulation of the hull of integer points, every circle empty, every distinct point a corner."""
    whole = points.astype(np.int64)
    areas = doubled_area(whole, triangles)
    assert (areas > 0).all()
    distinct = np.unique(whole, axis=0)
    assert areas.sum() == pytest.approx(2 * ConvexHull(distinct).volume, rel=1e-12)
    assert len(np.unique(triangles)) == len(distinct)
    np.testing.assert_array_equal(edges, reference.edges_of(triangles))
    assert len(distinct) - len(edges) + len(triangles) == 1
    plain = [tuple(map(int, p)) for p in whole]
    for t in triangles:
        assert not any(is_in_circle(*(plain[k] for k in t), p) for p in plain)


@pytest.mark.parametrize("count", [3, 4, 10, 100, 3000])
def test_random_points_as_scipy(count):
    points = np.random.default_rng(count).uniform(-50, 700, (count, 2))
    triangles, edges = delaunay(points)
    assert same_triangles(triangles, Delaunay(points).simplices)
    assert (doubled_area(points, triangles) > 0).all() and triangles.dtype == edges.dtype == np.int32
    np.testing.assert_array_equal(edges, reference.edges_of(triangles))


@pytest.mark.slow
def test_thousands_of_small_cases_on_few_places():
    """Of some fifty places many points coincide, lie on lines and on circles."""
    rng, flat = np.random.default_rng(0), 0
    for _ in range(3000):
        points = rng.integers(0, rng.integers(2, 9), (rng.integers(3, 16), 2)).astype(float)
        triangles, edges = delaunay(points)
        if np.linalg.matrix_rank(points - points[0]) < 2:
            assert len(triangles) == len(edges) == 0
            flat += 1
        else:
            check(points, triangles, edges)
    assert 50 < flat < 1500


@pytest.mark.parametrize("shape", [(2, 40), (40, 2), (12, 17)])
def test_lattices(shape):
    rows, columns = np.indices(shape)
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    check(points, *delaunay(points))
    shuffled = np.random.default_rng(1).permutation(points)
    check(shuffled, *delaunay(shuffled))


def points_on_a_circle():
    """Whole numbers (128, 2) at exactly the same distance from the origin: products of Gaussian primes, or their conjugates, squared."""
    found = {(7, 0)}
    for p, q in ((2, 1), (3, 2), (4, 1), (5, 2), (6, 1)):
        squares = [(p * p - q * q, s * 2 * p * q) for s in (1, -1)]
        found = {(u * c - v * d, u * d + v * c) for u, v in found for c, d in squares}
    found = {q for u, v in found for q in ((u, v), (-v, u), (-u, -v), (v, -u))}
    assert len(found) == 128 and len({u * u + v * v for u, v in found}) == 1
    return sorted(found)


def test_circles_that_float64_cannot_tell_are_decided_in_integers():
    points, rng, wrong = points_on_a_circle(), np.random.default_rng(6), 0
    for _ in range(500):
        chosen = [points[k] for k in rng.choice(len(points), 4, replace=False)]
        x, y = np.array(chosen, float).T.copy()
        assert not is_in_circle(*chosen) and not _is_in_circle(x, y, 0, 1, 2, 3)
        wrong += is_in_circle(*zip(x, y, strict=True), number=float)
        moved = (chosen[3][0] + int(rng.integers(-1, 2)), chosen[3][1] + 1)
        x[3], y[3] = moved
        assert _is_in_circle(x, y, 0, 1, 2, 3) == is_in_circle(*chosen[:3], moved)
    assert wrong > 20
    check(np.array(points, float), *delaunay(np.array(points, float)))


def test_products_of_fifty_bits_are_exact():
    for a, b in np.random.default_rng(7).integers(-(2**51), 2**51, (200, 2)):
        low, middle, high = _product_parts(float(a), float(b))
        assert low + 2**26 * middle + 2**52 * high == int(a) * int(b)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 2)),
        np.zeros((2, 2)),
        np.ones((50, 2)),
        np.column_stack([np.arange(30.0), np.full(30, 7.0)]),
        np.column_stack([np.full(30, 7.0), np.arange(30.0)]),
        np.column_stack([np.arange(30.0), 3.0 * np.arange(30.0)]),
    ],
)
def test_points_on_a_line_have_no_triangles(points):
    triangles, edges = delaunay(points)
    assert triangles.shape == (0, 3) and edges.shape == (0, 2)


def test_duplicates_are_left_out():
    points = np.random.default_rng(2).uniform(0, 100, (200, 2))
    triangles, _ = delaunay(np.concatenate([points, points]))
    first = np.unique(triangles % 200)
    assert len(first) == 200 and len(np.unique(triangles)) == 200
    assert same_triangles(triangles % 200, Delaunay(points).simplices)


def test_thin_and_tiny_and_far_away():
    rng = np.random.default_rng(3)
    for scale, offset in (([1e4, 1.0], 0.0), ([1e-6, 1e-6], 0.0), ([1.0, 1.0], 1e6)):
        points = rng.uniform(0, 1, (300, 2)) * scale + offset
        triangles, _ = delaunay(points)
        assert len(np.unique(triangles)) == 300
        assert np.abs(doubled_area(points, triangles)).sum() == pytest.approx(2 * ConvexHull(points).volume, rel=1e-6)


def test_the_same_twice():
    points = np.random.default_rng(4).uniform(0, 640, (2000, 2))
    for one, other in zip(delaunay(points), delaunay(points.copy()), strict=True):
        np.testing.assert_array_equal(one, other)
