# SPDX-License-Identifier: Apache-2.0
"""The observations as the kernels take them, eight at a time: those of a camera, or one each of eight points."""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import WIDTH, counting, gather, scatter, select, splat, square_root, total
from vitamin3d.geometry.reprojection import (
    in_camera,
    linearize_simd,
    model_of,
    models_of,
    points_of,
    pose_of,
    poses_of,
    squared_error_simd,
)
from vitamin3d.geometry.robust import geman_mcclure
from vitamin3d.types import Array


class Views(NamedTuple):
    """The cameras, for the kernels."""

    R: Array
    """(C, 3, 3)."""
    t: Array
    """(C, 3)."""
    slot: Array
    """(C,) int64: number among the free cameras, ascending, -1 where the camera is fixed."""
    models: Array
    """(C, 8) fx fy cx cy k1 k2 p1 p2 of each camera, or (1, 8) of all."""


STRETCH = 256
"""Points within it are sorted by length; it is short, as points that were made together are seen by the same cameras."""


class Sightings(NamedTuple):
    """The observations, sorted by point and again by camera, for the kernels."""

    starts: Array
    """(P + 1,) int64: of each point."""
    camera: Array
    """(M,) int32, ascending within a point."""
    pixels: Array
    """(M, 2)."""
    by_length: Array
    """(P,) int64: the points; stretches of them sorted by the number of observations, so that eight neighbours have about as many."""
    longest: int
    """The largest number of observations."""
    camera_starts: Array
    """(C + 1,) int64: of each camera, in the other order."""
    camera_point: Array
    """(M,) int32."""
    camera_pixels: Array
    """(M, 2)."""


@kernel
def longest_first(starts, order):  # type: ignore[no-untyped-def]
    """Fills order (P,): stretches of points, each by descending number of observations (a counting sort); returns the largest number."""
    P, longest = starts.shape[0] - 1, 0
    for p in range(P):
        longest = max(longest, starts[p + 1] - starts[p])
    cursor = np.empty(longest + 2, np.int64)
    for first in range(0, P, STRETCH):
        last = min(P, first + STRETCH)
        cursor[:] = 0
        for p in range(first, last):
            cursor[longest - (starts[p + 1] - starts[p]) + 1] += 1
        for n in range(longest):
            cursor[n + 1] += cursor[n]
        for p in range(first, last):
            n = longest - (starts[p + 1] - starts[p])
            order[first + cursor[n]] = p
            cursor[n] += 1
    return longest


@inlined
def models_are_distorted(models):  # type: ignore[no-untyped-def]
    """Whether any k1 k2 p1 p2 counts."""
    for m in range(models.shape[0]):
        for k in range(4, 8):
            if models[m, k] != 0.0:
                return True
    return False


# --- eight observations of a camera ------------------------------------------------------------------------------


@inlined
def rows_from(i, last):  # type: ignore[no-untyped-def]
    """Rows i.. of which `last` - 1 is the last, the first repeated behind it; and which are no repetition."""
    rows = counting(i)
    is_there = rows < last
    return select(is_there, rows, i), is_there


@inlined
def camera_rows(obs_point, pixels, points, i, last):  # type: ignore[no-untyped-def]
    """Observations i.. of a camera whose last is `last` - 1: rows, whether they are there, their points and pixels."""
    rows, is_there = rows_from(i, last)
    X, Y, Z = points_of(points, gather(obs_point, rows))
    return rows, is_there, X, Y, Z, gather(pixels, 2 * rows), gather(pixels, 2 * rows + 1)


@inlined
def linearize_rows(sightings, points, pose, model, is_distorted, i, last):  # type: ignore[no-untyped-def]
    """is_there, and `linearize_simd` of a camera's observations i.."""
    _, is_there, X, Y, Z, u, v = camera_rows(sightings.camera_point, sightings.camera_pixels, points, i, last)
    x, y, z = in_camera(pose, X, Y, Z)
    return is_there, linearize_simd(x, y, z, is_distorted, model, u, v)


@inlined
def cost_of_camera(sightings, points, pose, model, is_distorted, first, last, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """The robust cost of a camera's observations first.. to last - 1."""
    cost = splat(0.0)
    for i in range(first, last, WIDTH):
        _, is_there, X, Y, Z, u, v = camera_rows(sightings.camera_point, sightings.camera_pixels, points, i, last)
        x, y, z = in_camera(pose, X, Y, Z)
        cost = cost + robust_cost(is_there, squared_error_simd(x, y, z, is_distorted, model, u, v), inverse_squared_sigma)
    return total(cost)


@kernel
def total_cost(views, sightings, points, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """The robust cost, pixels²."""
    R, t, _, models = views
    starts, is_distorted, cost = sightings.camera_starts, models_are_distorted(models), 0.0
    for c in range(R.shape[0]):
        pose, model = pose_of(R, t, c), model_of(models, c if models.shape[0] > 1 else 0)
        cost += cost_of_camera(sightings, points, pose, model, is_distorted, starts[c], starts[c + 1], inverse_squared_sigma)
    return cost


@kernel
def squared_errors(views, starts, obs_point, pixels, points, out):  # type: ignore[no-untyped-def]
    """|r|² (M,) in pixels², inf behind the camera; the observations sorted by camera, starts (C + 1,)."""
    R, t, _, models = views
    is_distorted = models_are_distorted(models)
    for c in range(R.shape[0]):
        pose, model = pose_of(R, t, c), model_of(models, c if models.shape[0] > 1 else 0)
        for i in range(starts[c], starts[c + 1], WIDTH):
            rows, _, X, Y, Z, u, v = camera_rows(obs_point, pixels, points, i, starts[c + 1])
            x, y, z = in_camera(pose, X, Y, Z)
            scatter(out, rows, squared_error_simd(x, y, z, is_distorted, model, u, v))


# --- an observation each of eight points -------------------------------------------------------------------------


@inlined
def point_group(sightings, g):  # type: ignore[no-untyped-def]
    """Points g.. of `by_length`: their numbers, the last repeated; which are no repetition; first observations and how many; the most."""
    starts, by_length = sightings.starts, sightings.by_length
    P = by_length.shape[0]
    at = counting(g)
    is_new = at < P
    p = gather(by_length, select(is_new, at, P - 1))
    first = gather(starts, p)
    count = gather(starts, p + 1) - first
    longest = starts[by_length[g] + 1] - starts[by_length[g]]
    return p, is_new, select(count > 0, first, 0), count, longest


@inlined
def _sighting(sightings, first, count, n):  # type: ignore[no-untyped-def]
    """Observation n of each point: whether it is there, its camera and pixel."""
    is_there = n < count
    i = select(is_there, first + n, first)
    return is_there, gather(sightings.camera, i), gather(sightings.pixels, 2 * i), gather(sightings.pixels, 2 * i + 1)


@inlined
def linearize_sighting(views, sightings, is_distorted, X, Y, Z, first, count, n):  # type: ignore[no-untyped-def]
    """Observation n of eight points (X, Y, Z): is_there, the camera, its pose and model, and `linearize_simd`."""
    R, t, _, models = views
    is_there, c, u, v = _sighting(sightings, first, count, n)
    pose = poses_of(R, t, c)
    x, y, z = in_camera(pose, X, Y, Z)
    model = models_of(models, c) if models.shape[0] > 1 else model_of(models, 0)
    return is_there, c, pose, model, linearize_simd(x, y, z, is_distorted, model, u, v)


@inlined
def squared_error_sighting(views, sightings, is_distorted, X, Y, Z, first, count, n):  # type: ignore[no-untyped-def]
    """is_there, and |r|² of observation n of eight points."""
    R, t, _, models = views
    is_there, c, u, v = _sighting(sightings, first, count, n)
    x, y, z = in_camera(poses_of(R, t, c), X, Y, Z)
    model = models_of(models, c) if models.shape[0] > 1 else model_of(models, 0)
    return is_there, squared_error_simd(x, y, z, is_distorted, model, u, v)


# --- weights -----------------------------------------------------------------------------------------------------


@inlined
def robust_cost(is_there, e, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """Of |r|², eight times; a point behind the camera costs what the farthest outlier does, what is not there nothing."""
    cost = select(e < np.inf, geman_mcclure(e, inverse_squared_sigma)[0], 1.0 / inverse_squared_sigma)
    return select(is_there, cost, 0.0)


@inlined
def information(is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend):  # type: ignore[no-untyped-def]
    """Robust cost, weight w, G = pᵀ W p (00 01 11), h = pᵀ w r, and W (00 01 11): what derivatives by (a, b) are summed with.

    W is the weight w, less along the residual by the kernel's bending (rho'' < rho' / r): that makes steps longer, by
    1 / (1 - most_bend) at most; with 0 it is iteratively reweighted least squares.
    """
    e = r0 * r0 + r1 * r1
    cost, w = geman_mcclure(e, inverse_squared_sigma)
    cost = select(is_there, select(is_seen, cost, 1.0 / inverse_squared_sigma), 0.0)
    w = select(is_there & is_seen, w, 0.0)
    w00, w01, w11 = w, splat(0.0), w
    if most_bend > 0.0:
        full, most = 4.0 * inverse_squared_sigma * square_root(w), most_bend / e
        bend = w * select(full < most, full, most)
        w00, w01, w11 = w - bend * r0 * r0, -(bend * r0 * r1), w - bend * r1 * r1
    x0, x1 = w00 * p00 + w01 * p10, w01 * p00 + w11 * p10
    y0, y1 = w00 * p01 + w01 * p11, w01 * p01 + w11 * p11
    g00, g01, g11 = p00 * x0 + p10 * x1, p00 * y0 + p10 * y1, p01 * y0 + p11 * y1
    return cost, w, g00, g01, g11, w * (p00 * r0 + p10 * r1), w * (p01 * r0 + p11 * r1), w00, w01, w11
