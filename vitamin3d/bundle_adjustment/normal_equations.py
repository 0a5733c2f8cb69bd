# SPDX-License-Identifier: Apache-2.0
"""The Gauss–Newton equations with the points eliminated one by one (Eq. 9–10), and the step of cameras and points.

Variables: the poses of F free cameras, six each; K parameters of the camera model, either shared by all cameras (then
they are a border around the pose blocks) or each camera's own (then its block is 6 + K wide). The reduced system is
S = H_cc - H_cp H_pp⁻¹ H_cpᵀ. One pass by camera fills H_cc, eight observations at a time; one by point, eight points at a
time, linearises, eliminates the points while their blocks are at hand, and subtracts their parts from the upper triangle of S.
"""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import WIDTH, gather, load, scatter, select, splat, square_root, store, total, transposed
from vitamin3d.bundle_adjustment.observations import (
    Sightings,
    Views,
    information,
    linearize_rows,
    linearize_sighting,
    models_are_distorted,
    point_group,
    robust_cost,
    squared_error_sighting,
)
from vitamin3d.geometry.reprojection import model_derivatives, model_of, models_of, points_of, pose_of, retract
from vitamin3d.types import Array


def _padded(width: int) -> int:
    """The columns of a block of so many columns where it is read and written by lanes."""
    return -(-width // WIDTH) * WIDTH


def aligned_zeros(rows: int, columns: int) -> Array:
    """(rows, columns) such that lanes of eight columns lie in one line of the processor's cache each."""
    size = rows * columns
    flat = np.zeros(size + WIDTH)
    first = -(flat.ctypes.data // flat.itemsize) % WIDTH
    return flat[first : first + size].reshape(rows, columns)


class NormalEquations(NamedTuple):
    """F free cameras with D = 6 or 6 + K columns, K shared parameters or none, P points; N = D F + the shared ones."""

    reduced: Array
    """(N, N): -H_cp H_pp⁻¹ H_cpᵀ, upper triangle of blocks."""
    gradient: Array
    """(N,) of cameras and shared parameters."""
    lifted: Array
    """(N,): H_cp H_pp⁻¹ times the points' gradient; the right-hand side of the reduced system is lifted - gradient."""
    H_cameras: Array
    """(F, D, D), upper triangles."""
    H_border: Array
    """(F, 6, K) between the poses and shared parameters."""
    H_shared: Array
    """(K, K), upper triangle."""
    point_gradient: Array
    """(P, 3)."""
    root: Array
    """(P, 6): H_pp⁻¹ = L Lᵀ, L upper triangular (00 01 02 11 12 22); zeros where the point cannot move."""
    sums: Array
    """(N + 1, ..): where `reduced` and, in the last row, -`lifted` are summed: each block has eight columns, or sixteen if it needs
    them, so that it is read and written as a whole."""

    @staticmethod
    def zeros(num_free: int, width: int, num_shared: int, num_points: int) -> "NormalEquations":
        F, D, K = num_free, width, num_shared
        N = F * D + K
        shapes = ((N, N), (N,), (N,), (F, D, D), (F, 6, K), (K, K), (num_points, 3), (num_points, 6))
        arrays = [*map(np.zeros, shapes), aligned_zeros(N + 1, F * _padded(D) + _padded(K))]
        return NormalEquations(*arrays)

    def clear(self) -> None:
        """Zeros again, all but what is overwritten or cleared when it is read."""
        for array in (self.gradient, self.H_cameras, self.H_border, self.H_shared):
            array.fill(0.0)


# --- blocks ------------------------------------------------------------------------------------------------------


@inlined
def no_camera():  # type: ignore[no-untyped-def]
    """The empty sum of `add_camera`."""
    z = splat(0.0)
    return (z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z, z)


@inlined
def add_camera(s, q, a, b, g00, g01, g11, h0, h1):  # type: ignore[no-untyped-def]
    """Adds observations to Jᵀ h (6) and Jᵀ G J (21, upper triangle by rows) of a camera, eight sums each.

    J is that of `linearize_simd` without p; m = G (a, b), n = G (-b, a), written out: there is no time for loops.
    """
    hz = a * h0 + b * h1
    m0, m1, n0, n1 = g00 * a + g01 * b, g01 * a + g11 * b, g01 * a - g00 * b, g11 * a - g01 * b
    k, nz = a * m0 + b * m1, a * n0 + b * n1
    q0, q1, q2, qm0, qm1, qk = q * g00, q * g01, q * g11, q * m0, q * m1, q * k
    return (
        s[0] + q * h0, s[1] + q * h1, s[2] - q * hz, s[3] - (b * hz + h1), s[4] + (h0 + a * hz), s[5] + (a * h1 - b * h0),
        s[6] + q * q0, s[7] + q * q1, s[8] - q * qm0, s[9] - (b * qm0 + q1), s[10] + (a * qm0 + q0), s[11] + q * n0,
        s[12] + q * q2, s[13] - q * qm1, s[14] - (b * qm1 + q2), s[15] + (a * qm1 + q1), s[16] + q * n1,
        s[17] + q * qk, s[18] + (b * qk + qm1), s[19] - (a * qk + qm0), s[20] - q * nz,
        s[21] + (b * (b * k + 2.0 * m1) + g11), s[22] - (b * (a * k + m0) + a * m1 + g01), s[23] - (b * nz + n1),
        s[24] + (a * (a * k + 2.0 * m0) + g00), s[25] + (a * nz + n0), s[26] + (a * n1 - b * n0),
    )  # fmt: skip


@inlined
def write_camera(s, sums, H, g):  # type: ignore[no-untyped-def]
    """Writes the sums of `add_camera` to H (6.., 6..), upper triangle, and g (6..); `sums` (27,) is memory for it."""
    for k, part in enumerate(s):
        sums[k] = total(part)
    n = 6
    for i in range(6):
        g[i] = sums[i]
        for j in range(i, 6):
            H[i, j] = sums[n]
            n += 1


@inlined
def no_point():  # type: ignore[no-untyped-def]
    """The empty sum of `add_point`."""
    z = splat(0.0)
    return (z, z, z, z, z, z, z, z, z)


@inlined
def by_point(pose, q, a, b):  # type: ignore[no-untyped-def]
    """The derivative of (a, b) by the point, two rows of three."""
    return (
        q * (pose[0] - a * pose[6]), q * (pose[1] - a * pose[7]), q * (pose[2] - a * pose[8]),
        q * (pose[3] - b * pose[6]), q * (pose[4] - b * pose[7]), q * (pose[5] - b * pose[8]),
    )  # fmt: skip


@inlined
def weighted(J, g00, g01, g11):  # type: ignore[no-untyped-def]
    """G J of the two rows of three J."""
    return (
        g00 * J[0] + g01 * J[3], g00 * J[1] + g01 * J[4], g00 * J[2] + g01 * J[5],
        g01 * J[0] + g11 * J[3], g01 * J[1] + g11 * J[4], g01 * J[2] + g11 * J[5],
    )  # fmt: skip


@inlined
def add_point(s, J, x, h0, h1):  # type: ignore[no-untyped-def]
    """Adds an observation of each of eight points to Jᵀ G J (00 01 02 11 12 22) and Jᵀ h (3), given x = G J."""
    return (
        s[0] + (J[0] * x[0] + J[3] * x[3]), s[1] + (J[0] * x[1] + J[3] * x[4]), s[2] + (J[0] * x[2] + J[3] * x[5]),
        s[3] + (J[1] * x[1] + J[4] * x[4]), s[4] + (J[1] * x[2] + J[4] * x[5]), s[5] + (J[2] * x[2] + J[5] * x[5]),
        s[6] + (h0 * J[0] + h1 * J[3]), s[7] + (h0 * J[1] + h1 * J[4]), s[8] + (h0 * J[2] + h1 * J[5]),
    )  # fmt: skip


@inlined
def inverse_root(H, damping, count):  # type: ignore[no-untyped-def]
    """L upper triangular with H⁻¹ = L Lᵀ, by the Cholesky factor of H, its diagonal damped; both as 00 01 02 11 12 22.

    Zeros where H is singular, and where a point has fewer than two observations; and which of the eight are none of these.
    """
    more = 1.0 + damping
    H0, H3, H5 = more * H[0], more * H[3], more * H[5]
    i0 = 1.0 / square_root(H0)
    c10, c20 = H[1] * i0, H[2] * i0
    d11 = H3 - c10 * c10
    i1 = 1.0 / square_root(d11)
    c21 = (H[4] - c20 * c10) * i1
    d22 = H5 - c20 * c20 - c21 * c21
    i2 = 1.0 / square_root(d22)
    is_regular = (H0 > 0.0) & (d11 > 1e-14 * H3) & (d22 > 1e-14 * H5) & (count > 1)
    i01 = i0 * i1
    return is_regular, (
        select(is_regular, i0, 0.0), select(is_regular, -(c10 * i01), 0.0), select(is_regular, (c10 * c21 * i1 - c20) * i0 * i2, 0.0),
        select(is_regular, i1, 0.0), select(is_regular, -(c21 * i1 * i2), 0.0), select(is_regular, i2, 0.0),
    )  # fmt: skip


@inlined
def lifted_gradient(L, g0, g1, g2):  # type: ignore[no-untyped-def]
    """Lᵀ g."""
    return L[0] * g0, L[1] * g0 + L[3] * g1, L[2] * g0 + L[4] * g1 + L[5] * g2


@inlined
def point_step(L, g0, g1, g2):  # type: ignore[no-untyped-def]
    """H⁻¹ g = L Lᵀ g."""
    x, y, z = lifted_gradient(L, g0, g1, g2)
    return L[0] * x + L[1] * y + L[2] * z, L[3] * y + L[4] * z, L[5] * z


# --- the camera model's parameters -------------------------------------------------------------------------------


@inlined
def by_parameters(a, b, model, basis, Jk):  # type: ignore[no-untyped-def]
    """Writes to Jk (2, K, 8) the derivatives of the pixel by the K free parameters, eight observations at a time."""
    d = model_derivatives(a, b, model)
    K = basis.shape[1]
    for k in range(K):
        u = d[0] * basis[0, k] + d[1] * basis[4, k] + d[2] * basis[5, k] + d[3] * basis[6, k] + d[4] * basis[7, k]
        v = d[5] * basis[1, k] + d[6] * basis[4, k] + d[7] * basis[5, k] + d[8] * basis[6, k] + d[9] * basis[7, k]
        store(Jk, WIDTH * k, u + basis[2, k])
        store(Jk, WIDTH * (K + k), v + basis[3, k])


@inlined
def _add(sums, at, x):  # type: ignore[no-untyped-def]
    store(sums, WIDTH * at, load(sums, WIDTH * at) + x)


@inlined
def _add_model(Jk, K, q, a, b, p00, p01, p10, p11, r0, r1, w, w00, w01, w11, sums):  # type: ignore[no-untyped-def]
    """Adds observations to `sums` (7 + K, K, 8): the blocks with the pose (6, K), the gradient (K,) and the block itself (K, K).

    w, the gradient's weight, is that without the kernel's bending.
    """
    for k in range(K):
        j0, j1 = load(Jk, WIDTH * k), load(Jk, WIDTH * (K + k))
        x, y = w00 * j0 + w01 * j1, w01 * j0 + w11 * j1
        u, v = p00 * x + p10 * y, p01 * x + p11 * y
        z = a * u + b * v
        _add(sums, k, q * u)
        _add(sums, K + k, q * v)
        _add(sums, 2 * K + k, -(q * z))
        _add(sums, 3 * K + k, -(b * z + v))
        _add(sums, 4 * K + k, u + a * z)
        _add(sums, 5 * K + k, a * v - b * u)
        _add(sums, 6 * K + k, w * (j0 * r0 + j1 * r1))
        for n in range(k, K):
            _add(sums, 7 * K + K * k + n, x * load(Jk, WIDTH * n) + y * load(Jk, WIDTH * (K + n)))


@inlined
def _write_model(sums, K, H_pose, H_model, g):  # type: ignore[no-untyped-def]
    """Adds the sums of `_add_model` to their blocks; H_pose may have no rows."""
    for k in range(K):
        for m in range(H_pose.shape[0]):
            H_pose[m, k] += total(load(sums, WIDTH * (K * m + k)))
        g[k] += total(load(sums, WIDTH * (6 * K + k)))
        for n in range(k, K):
            H_model[k, n] += total(load(sums, WIDTH * (7 * K + K * k + n)))


# --- one pass by camera ------------------------------------------------------------------------------------------


class _CameraScratch(NamedTuple):
    """What a camera needs."""

    sums: Array
    """(27,)."""
    Jk: Array
    """(2, K, 8)."""
    of_model: Array
    """(7 + K, K, 8)."""


@kernel
def _accumulate_cameras(views, sightings, points, basis, inverse_squared_sigma, most_bend, equations, scratch):  # type: ignore[no-untyped-def]
    R, t, slot, models = views
    sums, Jk, of_model = scratch
    K, F, D = basis.shape[1], equations.H_cameras.shape[0], equations.H_cameras.shape[1]
    is_own, is_distorted, nothing = D > 6, models_are_distorted(models), np.empty((0, K))
    gradient = equations.gradient
    for c in range(R.shape[0]):
        f = slot[c]
        if f < 0 and (K == 0 or is_own):
            continue
        first, last = sightings.camera_starts[c], sightings.camera_starts[c + 1]
        pose, model = pose_of(R, t, c), model_of(models, c if models.shape[0] > 1 else 0)
        block = no_camera()
        of_model[:] = 0.0
        for i in range(first, last, WIDTH):
            is_there, seen = linearize_rows(sightings, points, pose, model, is_distorted, i, last)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = seen
            _, w, g00, g01, g11, h0, h1, w00, w01, w11 = information(
                is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend
            )
            block = add_camera(block, q, a, b, g00, g01, g11, h0, h1)
            if K > 0:
                by_parameters(a, b, model, basis, Jk)
                _add_model(Jk, K, q, a, b, p00, p01, p10, p11, r0, r1, w, w00, w01, w11, of_model)
        if f >= 0:
            write_camera(block, sums, equations.H_cameras[f], gradient[D * f :])
        if K > 0 and is_own:
            H = equations.H_cameras[f]
            _write_model(of_model, K, H[:6, 6:], H[6:, 6:], gradient[D * f + 6 :])
        elif K > 0:
            _write_model(of_model, K, equations.H_border[f] if f >= 0 else nothing, equations.H_shared, gradient[D * F :])


# --- one pass by point -------------------------------------------------------------------------------------------


class _Scratch(NamedTuple):
    """What eight points need, for the longest track of n observations."""

    terms: Array
    """(n + 1, 9, 8): q a b, the two rows of G Jp (3 each)."""
    Jk: Array
    """(2, K, 8)."""
    W: Array
    """(n + 1, 3, K, 8): Jpᵀ G Jk of each observation, where cameras have parameters of their own; else the sum is the first."""
    z: Array
    """(3, 8): Lᵀ g."""
    columns: Array
    """(8 (n + 1), 3 padded D): of each point and observation the three rows of Lᵀ H_pc, and last those of the shared parameters;
    zeros behind D."""
    blocks: Array
    """(n + 1, 4): of the observations by free cameras where they begin in `columns`, first row and column in `sums`, and how wide
    they are, zeros included."""


def _scratch(sightings: Sightings, width: int, K: int) -> _Scratch:
    n = sightings.longest
    W = np.empty((n + 1 if width > 6 else 1, 3, K, WIDTH))
    columns = aligned_zeros(WIDTH * (n + 1), 3 * max(_padded(width), _padded(K)))
    terms, Jk, z = (np.empty((*shape, WIDTH)) for shape in ((n + 1, 9), (2, K), (3,)))
    return _Scratch(terms, Jk, W, z, columns, np.empty((n + 1, 4), np.int64))


@inlined
def _write_rows(x, columns, n, many, at):  # type: ignore[no-untyped-def]
    """Writes eight columns of eight points, one of x (8,) after another, to columns `at`.. of the points' rows n of `many`."""
    of_points, stride = transposed(x), columns.shape[1]
    for k in range(WIDTH):
        store(columns, stride * (many * k + n) + at, of_points[k])


@inlined
def _pose_columns(terms, n, L, model, columns, many):  # type: ignore[no-untyped-def]
    """Writes the three rows of Lᵀ H_pc of observation n of eight points: six columns by the pose, two by the camera's `model`."""
    k, size = 9 * WIDTH * n, columns.shape[1] // 3
    q, a, b = load(terms, k), load(terms, k + WIDTH), load(terms, k + 2 * WIDTH)
    x = lifted_gradient(L, load(terms, k + 3 * WIDTH), load(terms, k + 4 * WIDTH), load(terms, k + 5 * WIDTH))
    y = lifted_gradient(L, load(terms, k + 6 * WIDTH), load(terms, k + 7 * WIDTH), load(terms, k + 8 * WIDTH))
    for r in range(3):
        z = a * x[r] + b * y[r]
        six = q * x[r], q * y[r], -(q * z), -(b * z + y[r]), x[r] + a * z, a * y[r] - b * x[r]
        _write_rows((*six, model[0][r], model[1][r]), columns, n, many, size * r)


@inlined
def _by_model(W, n, K, k, L):  # type: ignore[no-untyped-def]
    """Lᵀ times column k of W[n] (3, K, 8): three lanes; zeros where there is no such column."""
    if k >= K:
        z = splat(0.0)
        return z, z, z
    at = WIDTH * (3 * K * n + k)
    return lifted_gradient(L, load(W, at), load(W, at + WIDTH * K), load(W, at + 2 * WIDTH * K))


@inlined
def _model_columns(W, n, K, first, L, columns, row, many):  # type: ignore[no-untyped-def]
    """Writes columns first.. of Lᵀ W of eight points to their rows `row`, where each begins with `first` - 8 or no others before."""
    size = columns.shape[1] // 3
    for k in range(first, K, WIDTH):
        c0, c1, c2, c3 = _by_model(W, n, K, k, L), _by_model(W, n, K, k + 1, L), _by_model(W, n, K, k + 2, L), _by_model(W, n, K, k + 3, L)
        c4, c5, c6, c7 = (
            _by_model(W, n, K, k + 4, L), _by_model(W, n, K, k + 5, L), _by_model(W, n, K, k + 6, L), _by_model(W, n, K, k + 7, L),
        )  # fmt: skip
        for r in range(3):
            at = size * r + k - first + (WIDTH if first > 0 else 0)
            _write_rows((c0[r], c1[r], c2[r], c3[r], c4[r], c5[r], c6[r], c7[r]), columns, row, many, at)


@inlined
def _add_point_model(Jk, K, J, p00, p01, p10, p11, w00, w01, w11, W, n):  # type: ignore[no-untyped-def]
    """W[n] (3, K, 8) += Jpᵀ pᵀ W Jk of an observation of each of eight points, J the derivative of (a, b) by the point."""
    for k in range(K):
        j0, j1 = load(Jk, WIDTH * k), load(Jk, WIDTH * (K + k))
        x, y = w00 * j0 + w01 * j1, w01 * j0 + w11 * j1
        u, v = p00 * x + p10 * y, p01 * x + p11 * y
        _add(W, 3 * K * n + k, u * J[0] + v * J[3])
        _add(W, 3 * K * n + K + k, u * J[1] + v * J[4])
        _add(W, 3 * K * n + 2 * K + k, u * J[2] + v * J[5])


@inlined
def _subtract_six_rows(columns, size, blocks, i, num, sums, stride):  # type: ignore[no-untyped-def]
    """The first six rows of block i of `_subtract_products`: there is no time for loops, and six rows share what is read."""
    first, to = blocks[i, 0], stride * blocks[i, 1]
    V = columns.reshape(-1)
    u0, u1, u2, u3, u4, u5 = V[first], V[first + 1], V[first + 2], V[first + 3], V[first + 4], V[first + 5]
    first += size
    v0, v1, v2, v3, v4, v5 = V[first], V[first + 1], V[first + 2], V[first + 3], V[first + 4], V[first + 5]
    first += size
    w0, w1, w2, w3, w4, w5 = V[first], V[first + 1], V[first + 2], V[first + 3], V[first + 4], V[first + 5]
    for j in range(i, num):
        for n in range(0, blocks[j, 3], WIDTH):
            at, k = blocks[j, 0] + n, to + blocks[j, 2] + n
            x, y, z = load(columns, at), load(columns, at + size), load(columns, at + 2 * size)
            store(sums, k, load(sums, k) - u0 * x - v0 * y - w0 * z)
            store(sums, k + stride, load(sums, k + stride) - u1 * x - v1 * y - w1 * z)
            store(sums, k + 2 * stride, load(sums, k + 2 * stride) - u2 * x - v2 * y - w2 * z)
            store(sums, k + 3 * stride, load(sums, k + 3 * stride) - u3 * x - v3 * y - w3 * z)
            store(sums, k + 4 * stride, load(sums, k + 4 * stride) - u4 * x - v4 * y - w4 * z)
            store(sums, k + 5 * stride, load(sums, k + 5 * stride) - u5 * x - v5 * y - w5 * z)


@inlined
def _subtract_row(columns, size, blocks, i, num, u, v, w, sums, to):  # type: ignore[no-untyped-def]
    """One row of `_subtract_products` from block i on: `to` is where it begins, u v w what it has in the three rows of `columns`."""
    for j in range(i, num):
        for n in range(0, blocks[j, 3], WIDTH):
            at, k = blocks[j, 0] + n, to + blocks[j, 2] + n
            x, y, z = load(columns, at), load(columns, at + size), load(columns, at + 2 * size)
            store(sums, k, load(sums, k) - u * x - v * y - w * z)


@inlined
def _subtract_products(columns, blocks, num, width, num_shared, z, sums):  # type: ignore[no-untyped-def]
    """sums -= Vᵀ [V z], upper triangle of blocks, V the `num` blocks of a point, the last one of shared parameters if there are any."""
    stride, size, V = sums.shape[1], columns.shape[1] // 3, columns.reshape(-1)
    for i in range(num):
        rows = num_shared if num_shared > 0 and i == num - 1 else width
        six = 6 if rows >= 6 else 0
        if six:
            _subtract_six_rows(columns, size, blocks, i, num, sums, stride)
        for m in range(six, rows):
            at, to = blocks[i, 0] + m, stride * (blocks[i, 1] + m)
            _subtract_row(columns, size, blocks, i, num, V[at], V[at + size], V[at + 2 * size], sums, to)
    _subtract_row(columns, size, blocks, 0, num, z[0], z[1], z[2], sums, stride * (sums.shape[0] - 1))


@inlined
def _eliminate(cameras, slot, first_row, num_shared, z, equations, scratch):  # type: ignore[no-untyped-def]
    """Subtracts what a point that `cameras` see knows from `sums`; its rows of `columns` begin at first_row."""
    F, D = equations.H_cameras.shape[0], equations.H_cameras.shape[1]
    wide, wide_shared = -(-D // WIDTH) * WIDTH, -(-num_shared // WIDTH) * WIDTH
    blocks, num, last_row = scratch.blocks, 0, first_row + scratch.terms.shape[0] - 1
    row_size = scratch.columns.shape[1]
    for n in range(cameras.shape[0]):
        f = slot[cameras[n]]
        if f >= 0:
            blocks[num, 0], blocks[num, 1], blocks[num, 2], blocks[num, 3] = row_size * (first_row + n), D * f, wide * f, wide
            num += 1
    if num_shared > 0:
        blocks[num, 0], blocks[num, 1], blocks[num, 2], blocks[num, 3] = row_size * last_row, D * F, wide * F, wide_shared
        num += 1
    _subtract_products(scratch.columns, blocks, num, D, num_shared, z, equations.sums)


@kernel
def _read_sums(equations, num_shared):  # type: ignore[no-untyped-def]
    """Moves `sums` to `reduced` and `lifted`."""
    sums, F, D = equations.sums, equations.H_cameras.shape[0], equations.H_cameras.shape[1]
    N, wide = sums.shape[0] - 1, -(-D // WIDTH) * WIDTH
    for row in range(N + 1):
        begin = 0 if row == N else min(row // D, F)
        out = equations.lifted if row == N else equations.reduced[row]
        sign = -1.0 if row == N else 1.0
        for f in range(begin, F + (num_shared > 0)):
            for m in range(D if f < F else num_shared):
                out[D * f + m] = sign * sums[row, wide * f + m]
        sums[row] = 0.0


@kernel
def _accumulate_points(views, sightings, points, basis, inverse_squared_sigma, most_bend, damping, is_reduced, equations, scratch):  # type: ignore[no-untyped-def]
    slot, terms, Jk, W, columns = views.slot, scratch.terms, scratch.Jk, scratch.W, scratch.columns
    K, D = basis.shape[1], equations.H_cameras.shape[1]
    is_own, is_distorted = D > 6, models_are_distorted(views.models)
    num_shared, many, nothing = 0 if is_own else K, terms.shape[0], (splat(0.0), splat(0.0), splat(0.0))
    cost = 0.0
    for g in range(0, points.shape[0], WIDTH):
        p, is_new, first, count, longest = point_group(sightings, g)
        X, Y, Z = points_of(points, p)
        block, costs = no_point(), splat(0.0)
        if num_shared > 0:
            W[0] = 0.0
        for n in range(longest):
            is_there, _, pose, model, seen = linearize_sighting(views, sightings, is_distorted, X, Y, Z, first, count, n)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = seen
            rho, _, g00, g01, g11, h0, h1, w00, w01, w11 = information(
                is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend
            )
            costs = costs + rho
            J = by_point(pose, q, a, b)
            x = weighted(J, g00, g01, g11)
            block = add_point(block, J, x, h0, h1)
            k = 9 * WIDTH * n
            store(terms, k, q)
            store(terms, k + WIDTH, a)
            store(terms, k + 2 * WIDTH, b)
            for m in range(6):
                store(terms, k + (3 + m) * WIDTH, x[m])
            if K > 0:
                by_parameters(a, b, model, basis, Jk)
                if is_own:
                    W[n] = 0.0
                _add_point_model(Jk, K, J, p00, p01, p10, p11, w00, w01, w11, W, n if is_own else 0)
        cost += total(select(is_new, costs, 0.0))
        _, L = inverse_root(block, damping, count)
        z = lifted_gradient(L, block[6], block[7], block[8])
        for m in range(3):
            scatter(equations.point_gradient, 3 * p + m, block[6 + m])
            store(scratch.z, WIDTH * m, z[m])
        for m in range(6):
            scatter(equations.root, 6 * p + m, L[m])
        if not is_reduced:
            continue
        for n in range(longest):
            more = (_by_model(W, n, K, 0, L), _by_model(W, n, K, 1, L)) if is_own else (nothing, nothing)
            _pose_columns(terms, n, L, more, columns, many)
            if is_own:
                _model_columns(W, n, K, 2, L, columns, n, many)
        if num_shared > 0:
            _model_columns(W, 0, K, 0, L, columns, many - 1, many)
        for lane in range(min(WIDTH, points.shape[0] - g)):
            number = sightings.by_length[g + lane]
            seen_by = sightings.camera[sightings.starts[number] : sightings.starts[number + 1]]
            if equations.root[number, 0] != 0.0:
                z = (scratch.z[0, lane], scratch.z[1, lane], scratch.z[2, lane])
                _eliminate(seen_by, slot, many * lane, num_shared, z, equations, scratch)
    _read_sums(equations, num_shared)
    return cost


def accumulate(
    views: Views, sightings: Sightings, points: Array, basis: Array, inverse_squared_sigma: float, most_bend: float, damping: float,
    equations: NormalEquations, is_reduced: bool = True,
) -> float:  # fmt: skip
    """Fills `equations` at the present variables, H_pp damped by its diagonal; returns the cost.

    Args:
        basis: (8, K); the camera model moves by basis @ step of its K free parameters.
        inverse_squared_sigma: of the robust kernel; 0 is plain least squares.
        most_bend: see `information`.
        is_reduced: whether the points are eliminated, `reduced` and `lifted` filled.
    """
    equations.clear()
    K = basis.shape[1]
    of_cameras = _CameraScratch(np.empty(27), np.empty((2, K, WIDTH)), np.empty((7 + K, K, WIDTH)))
    _accumulate_cameras(views, sightings, points, basis, inverse_squared_sigma, most_bend, equations, of_cameras)
    scratch = _scratch(sightings, equations.H_cameras.shape[1], K)
    by_point = basis, inverse_squared_sigma, most_bend, damping, is_reduced, equations, scratch
    return float(_accumulate_points(views, sightings, points, *by_point))


# --- the step ----------------------------------------------------------------------------------------------------


@kernel
def move_cameras(views, delta, R_new, t_new):  # type: ignore[no-untyped-def]
    """Poses after the steps delta (F, D), pose first, of the free cameras."""
    for c in range(views.R.shape[0]):
        f = views.slot[c]
        if f >= 0:
            retract(delta[f], views.R[c], views.t[c], R_new[c], t_new[c])
        else:
            R_new[c], t_new[c] = views.R[c], views.t[c]


@inlined
def _lead(slot, c, q, a, b, delta):  # type: ignore[no-untyped-def]
    """How far (a, b) moves with the steps delta (F, D) of cameras c; fixed ones stay."""
    f, D = gather(slot, c), delta.shape[1]
    is_free, at = f >= 0, D * f
    at = select(is_free, at, 0)
    d0, d1, d2 = gather(delta, at), gather(delta, at + 1), gather(delta, at + 2)
    d3, d4, d5 = gather(delta, at + 3), gather(delta, at + 4), gather(delta, at + 5)
    turn = b * d3 - a * d4 + q * d2
    da, db = q * d0 + d4 - b * d5 - a * turn, q * d1 - d3 + a * d5 - b * turn
    return select(is_free, da, 0.0), select(is_free, db, 0.0)


@inlined
def _model_lead(a, b, model, moved):  # type: ignore[no-untyped-def]
    """How far the pixels move with the camera models."""
    d = model_derivatives(a, b, model)
    s0, s1, s2, s3 = moved[0] - model[0], moved[1] - model[1], moved[2] - model[2], moved[3] - model[3]
    s4, s5, s6, s7 = moved[4] - model[4], moved[5] - model[5], moved[6] - model[6], moved[7] - model[7]
    u = d[0] * s0 + s2 + d[1] * s4 + d[2] * s5 + d[3] * s6 + d[4] * s7
    return u, d[5] * s1 + s3 + d[6] * s4 + d[7] * s5 + d[8] * s6 + d[9] * s7


@kernel
def move_points(views, moved, sightings, points, delta, inverse_squared_sigma, most_bend, equations, out):  # type: ignore[no-untyped-def]
    """Eq. 10: out (P, 3) = the points after the cameras went from `views` to `moved` by delta (F, D); returns the cost there."""
    models, slot = views.models, views.slot
    is_distorted, now_distorted = models_are_distorted(models), models_are_distorted(moved.models)
    is_model_free = False
    for m in range(models.shape[0]):
        for k in range(8):
            is_model_free |= models[m, k] != moved.models[m, k]
    root, point_gradient, is_some_free = equations.root, equations.point_gradient, delta.shape[0] > 0
    cost = 0.0
    for g in range(0, points.shape[0], WIDTH):
        p, is_new, first, count, longest = point_group(sightings, g)
        X, Y, Z = points_of(points, p)
        g0, g1, g2 = points_of(point_gradient, p)
        for n in range(longest if is_some_free or is_model_free else 0):
            is_there, c, pose, model, seen = linearize_sighting(views, sightings, is_distorted, X, Y, Z, first, count, n)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = seen
            _, _, g00, g01, g11, _, _, w00, w01, w11 = information(
                is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend
            )
            h0, h1 = splat(0.0), splat(0.0)
            if is_some_free:
                da, db = _lead(slot, c, q, a, b, delta)
                h0, h1 = g00 * da + g01 * db, g01 * da + g11 * db
            if is_model_free:
                to = models_of(moved.models, c) if models.shape[0] > 1 else model_of(moved.models, 0)
                x, y = _model_lead(a, b, model, to)
                u, v = w00 * x + w01 * y, w01 * x + w11 * y
                h0, h1 = h0 + p00 * u + p10 * v, h1 + p01 * u + p11 * v
            J = by_point(pose, q, a, b)
            g0, g1, g2 = g0 + (h0 * J[0] + h1 * J[3]), g1 + (h0 * J[1] + h1 * J[4]), g2 + (h0 * J[2] + h1 * J[5])
        r = 6 * p
        L = (gather(root, r), gather(root, r + 1), gather(root, r + 2), gather(root, r + 3), gather(root, r + 4), gather(root, r + 5))
        d0, d1, d2 = point_step(L, g0, g1, g2)
        X, Y, Z = X - d0, Y - d1, Z - d2
        scatter(out, 3 * p, X)
        scatter(out, 3 * p + 1, Y)
        scatter(out, 3 * p + 2, Z)
        costs = splat(0.0)
        for n in range(longest):
            is_there, e = squared_error_sighting(moved, sightings, now_distorted, X, Y, Z, first, count, n)
            costs = costs + robust_cost(is_there, e, inverse_squared_sigma)
        cost += total(select(is_new, costs, 0.0))
    return cost


@kernel
def scale_upper(S, scale):  # type: ignore[no-untyped-def]
    """S[i, j] *= scale[i] scale[j] in the upper triangle."""
    for i in range(S.shape[0]):
        for j in range(i, S.shape[0]):
            S[i, j] *= scale[i] * scale[j]
