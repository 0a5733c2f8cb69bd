# SPDX-License-Identifier: Apache-2.0
"""The Gauss–Newton equations with the points eliminated one by one (Eq. 9–10), and the step of cameras and points.

Variables: the poses of F free cameras, six each; K parameters of the camera model, either shared by all cameras (then
they are a border around the pose blocks) or each camera's own (then its block is 6 + K wide). The reduced system is
S = H_cc - H_cp H_pp⁻¹ H_cpᵀ. One pass over the observations, sorted by point, linearises them, eliminates the
point while its blocks are at hand, and subtracts its part from the upper triangle of S.
"""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.reprojection import in_camera, linearize_normalized, model_derivatives, retract, squared_error_normalized
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


class Sightings(NamedTuple):
    """The observations sorted by point, for the kernels."""

    starts: Array
    """(P + 1,) int64."""
    camera: Array
    """(M,) int32, ascending within a point."""
    pixels: Array
    """(M, 2)."""


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

    @staticmethod
    def zeros(num_free: int, width: int, num_shared: int, num_points: int) -> "NormalEquations":
        F, D, K = num_free, width, num_shared
        N = F * D + K
        shapes = ((N, N), (N,), (N,), (F, D, D), (F, 6, K), (K, K), (num_points, 3), (num_points, 6))
        return NormalEquations(*(np.zeros(shape) for shape in shapes))

    def clear(self) -> None:
        """Zeros again, all but what is overwritten."""
        for array in self[:6]:
            array.fill(0.0)


class _Scratch(NamedTuple):
    """What one point needs, for the longest track."""

    terms: Array
    """(n, 9): q a b, the two rows of G Jp (3 each)."""
    J: Array
    """(2, 8) by the camera model."""
    Jk: Array
    """(2, K) by its free parameters."""
    V: Array
    """(3, D n + K) columns of H_cp L."""
    column: Array
    """(n + 1,) column of S where each block of V goes."""
    end: Array
    """(n + 1,) after how many blocks the neighbours' columns cease to be neighbours."""
    W: Array
    """(n, 3, K): Jpᵀ G Jk of each observation, where cameras have parameters of their own; else the sum is the first."""


@kernel
def _longest(starts):  # type: ignore[no-untyped-def]
    longest = 0
    for p in range(starts.shape[0] - 1):
        longest = max(longest, starts[p + 1] - starts[p])
    return longest


def _scratch(starts: Array, width: int, K: int) -> _Scratch:
    n = int(_longest(starts))
    V, W = np.empty((3, width * n + K)), np.empty((n if width > 6 else 1, 3, K))
    integers = np.empty((2, n + 1), np.int64)
    return _Scratch(np.empty((n, 9)), np.empty((2, 8)), np.empty((2, K)), V, integers[0], integers[1], W)


@inlined
def inverse_root(H0, H1, H2, H3, H4, H5):  # type: ignore[no-untyped-def]
    """L upper triangular with H⁻¹ = L Lᵀ, by the Cholesky factor of H; both as 00 01 02 11 12 22. Zeros where H is singular."""
    c00 = np.sqrt(max(H0, 0.0))
    c10, c20 = H1 / c00, H2 / c00
    d11 = H3 - c10 * c10
    c11 = np.sqrt(max(d11, 0.0))
    c21 = (H4 - c20 * c10) / c11
    d22 = H5 - c20 * c20 - c21 * c21
    if not (H0 > 0.0 and d11 > 1e-14 * H3 and d22 > 1e-14 * H5):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    c22 = np.sqrt(d22)
    return (
        1.0 / c00, -c10 / (c00 * c11), (c10 * c21 - c20 * c11) / (c00 * c11 * c22), 1.0 / c11, -c21 / (c11 * c22), 1.0 / c22,
    )  # fmt: skip


@inlined
def linearize_observation(R, t, c, models, m, is_distorted, points, n, pixels, i):  # type: ignore[no-untyped-def]
    """`linearize_normalized` of observation i: point n from camera c of model m."""
    x, y, z = in_camera(R, t, c, points, n)
    return linearize_normalized(
        x, y, z, is_distorted, models[m, 0], models[m, 1], models[m, 2], models[m, 3], models[m, 4], models[m, 5], models[m, 6],
        models[m, 7], pixels[i, 0], pixels[i, 1],
    )  # fmt: skip


@inlined
def observation_error(R, t, c, models, m, is_distorted, points, n, pixels, i):  # type: ignore[no-untyped-def]
    """`squared_error_normalized` of observation i: point n from camera c of model m."""
    x, y, z = in_camera(R, t, c, points, n)
    return squared_error_normalized(
        x, y, z, is_distorted, models[m, 0], models[m, 1], models[m, 2], models[m, 3], models[m, 4], models[m, 5], models[m, 6],
        models[m, 7], pixels[i, 0], pixels[i, 1],
    )  # fmt: skip


@inlined
def information(r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend):  # type: ignore[no-untyped-def]
    """Robust cost, G = pᵀ W p (00 01 11), h = pᵀ w r, and W (00 01 11): what derivatives by (a, b) are summed with.

    W is the weight w, less along the residual by the kernel's bending (rho'' < rho' / r): that makes steps longer, by
    1 / (1 - most_bend) at most; with 0 it is iteratively reweighted least squares.
    """
    e = r0 * r0 + r1 * r1
    cost, w = geman_mcclure(e, inverse_squared_sigma)
    w00, w01, w11 = w, 0.0, w
    if most_bend > 0.0 and e > 0.0:
        bend = w * min(4.0 * inverse_squared_sigma * np.sqrt(w), most_bend / e)
        w00, w01, w11 = w - bend * r0 * r0, -bend * r0 * r1, w - bend * r1 * r1
    x0, x1 = w00 * p00 + w01 * p10, w01 * p00 + w11 * p10
    y0, y1 = w00 * p01 + w01 * p11, w01 * p01 + w11 * p11
    g00, g01, g11 = p00 * x0 + p10 * x1, p00 * y0 + p10 * y1, p01 * y0 + p11 * y1
    return cost, g00, g01, g11, w * (p00 * r0 + p10 * r1), w * (p01 * r0 + p11 * r1), w00, w01, w11


@inlined
def add_camera(H, f, g, at, q, a, b, g00, g01, g11, h0, h1):  # type: ignore[no-untyped-def]
    """Adds an observation to block f of H (F, 6.., 6..) and the gradient g from `at`: Jᵀ G J and Jᵀ h, upper triangle.

    J is that of `linearize_normalized` without p; m = G (a, b), n = G (-b, a), written out: there is no time for loops.
    """
    hz = a * h0 + b * h1
    g[at] += q * h0
    g[at + 1] += q * h1
    g[at + 2] -= q * hz
    g[at + 3] -= b * hz + h1
    g[at + 4] += h0 + a * hz
    g[at + 5] += a * h1 - b * h0
    m0, m1, n0, n1 = g00 * a + g01 * b, g01 * a + g11 * b, g01 * a - g00 * b, g11 * a - g01 * b
    k, nz = a * m0 + b * m1, a * n0 + b * n1
    q0, q1, q2, qm0, qm1, qk = q * g00, q * g01, q * g11, q * m0, q * m1, q * k
    H[f, 0, 0] += q * q0
    H[f, 0, 1] += q * q1
    H[f, 0, 2] += -q * qm0
    H[f, 0, 3] += -b * qm0 - q1
    H[f, 0, 4] += a * qm0 + q0
    H[f, 0, 5] += q * n0
    H[f, 1, 1] += q * q2
    H[f, 1, 2] += -q * qm1
    H[f, 1, 3] += -b * qm1 - q2
    H[f, 1, 4] += a * qm1 + q1
    H[f, 1, 5] += q * n1
    H[f, 2, 2] += q * qk
    H[f, 2, 3] += b * qk + qm1
    H[f, 2, 4] += -a * qk - qm0
    H[f, 2, 5] += -q * nz
    H[f, 3, 3] += b * (b * k + 2.0 * m1) + g11
    H[f, 3, 4] += -b * (a * k + m0) - a * m1 - g01
    H[f, 3, 5] += -b * nz - n1
    H[f, 4, 4] += a * (a * k + 2.0 * m0) + g00
    H[f, 4, 5] += a * nz + n0
    H[f, 5, 5] += a * n1 - b * n0


@inlined
def _add_model(Jk, q, a, b, p00, p01, p10, p11, r0, r1, w, w00, w01, w11, H_pose, H_model, g):  # type: ignore[no-untyped-def]
    """Adds an observation to the blocks of the camera model: with the pose (6, K), itself (K, K), and its gradient g (K,).

    w, the gradient's weight, is that without the kernel's bending.
    """
    for k in range(Jk.shape[1]):
        x, y = w00 * Jk[0, k] + w01 * Jk[1, k], w01 * Jk[0, k] + w11 * Jk[1, k]
        g[k] += w * (Jk[0, k] * r0 + Jk[1, k] * r1)
        for n in range(k, Jk.shape[1]):
            H_model[k, n] += x * Jk[0, n] + y * Jk[1, n]
        if H_pose.shape[0] == 6:
            u, v = p00 * x + p10 * y, p01 * x + p11 * y
            z = a * u + b * v
            H_pose[0, k] += q * u
            H_pose[1, k] += q * v
            H_pose[2, k] -= q * z
            H_pose[3, k] -= b * z + v
            H_pose[4, k] += u + a * z
            H_pose[5, k] += a * v - b * u


@inlined
def _columns(terms, i, L0, L1, L2, L3, L4, L5, V, at):  # type: ignore[no-untyped-def]
    """Columns at.. of V (3, N): the six rows of H_cp L of observation i of `terms`."""
    q, a, b = terms[i, 0], terms[i, 1], terms[i, 2]
    x0, x1, x2 = terms[i, 3] * L0, terms[i, 3] * L1 + terms[i, 4] * L3, terms[i, 3] * L2 + terms[i, 4] * L4 + terms[i, 5] * L5
    y0, y1, y2 = terms[i, 6] * L0, terms[i, 6] * L1 + terms[i, 7] * L3, terms[i, 6] * L2 + terms[i, 7] * L4 + terms[i, 8] * L5
    z0, z1, z2 = a * x0 + b * y0, a * x1 + b * y1, a * x2 + b * y2
    V[0, at], V[1, at], V[2, at] = q * x0, q * x1, q * x2
    V[0, at + 1], V[1, at + 1], V[2, at + 1] = q * y0, q * y1, q * y2
    V[0, at + 2], V[1, at + 2], V[2, at + 2] = -q * z0, -q * z1, -q * z2
    V[0, at + 3], V[1, at + 3], V[2, at + 3] = -b * z0 - y0, -b * z1 - y1, -b * z2 - y2
    V[0, at + 4], V[1, at + 4], V[2, at + 4] = x0 + a * z0, x1 + a * z1, x2 + a * z2
    V[0, at + 5], V[1, at + 5], V[2, at + 5] = a * y0 - b * x0, a * y1 - b * x1, a * y2 - b * x2


@inlined
def _model_columns(W, i, L0, L1, L2, L3, L4, L5, V, at):  # type: ignore[no-untyped-def]
    """Columns at.. of V: the rows of (Jkᵀ G Jp) L of W[i] (3, K)."""
    for k in range(W.shape[2]):
        V[0, at + k] = W[i, 0, k] * L0
        V[1, at + k] = W[i, 0, k] * L1 + W[i, 1, k] * L3
        V[2, at + k] = W[i, 0, k] * L2 + W[i, 1, k] * L4 + W[i, 2, k] * L5


@inlined
def _subtract_products(V, blocks, width, num_columns, column, end, S):  # type: ignore[no-untyped-def]
    """S -= Vᵀ V: block i of V, columns width i.., goes to column[i].. of S; upper triangle of blocks. end[i]: see `_Scratch`.

    Neighbouring cameras have neighbouring columns, so that the inner loop runs over a track; three rows share its loads.
    """
    for i in range(blocks):
        first = width * i
        rows = min(width, num_columns - first)
        for m in range(0, rows - rows % 3, 3):
            at = first + m
            u0, v0, w0 = V[0, at], V[1, at], V[2, at]
            u1, v1, w1 = V[0, at + 1], V[1, at + 1], V[2, at + 1]
            u2, v2, w2 = V[0, at + 2], V[1, at + 2], V[2, at + 2]
            row0, row1, row2 = S[column[i] + m], S[column[i] + m + 1], S[column[i] + m + 2]
            j = i
            while j < blocks:
                start, stop, to = width * j, min(width * end[j], num_columns), column[j]
                A, B, C = V[0, start:stop], V[1, start:stop], V[2, start:stop]
                size = stop - start
                D0, D1, D2 = row0[to : to + size], row1[to : to + size], row2[to : to + size]
                for n in range(size):
                    x, y, z = A[n], B[n], C[n]
                    D0[n] -= u0 * x + v0 * y + w0 * z
                    D1[n] -= u1 * x + v1 * y + w1 * z
                    D2[n] -= u2 * x + v2 * y + w2 * z
                j = end[j]
        for m in range(rows - rows % 3, rows):
            u0, v0, w0, row0 = V[0, first + m], V[1, first + m], V[2, first + m], S[column[i] + m]
            j = i
            while j < blocks:
                start, stop = width * j, min(width * end[j], num_columns)
                for n in range(start, stop):
                    row0[column[j] + n - start] -= u0 * V[0, n] + v0 * V[1, n] + w0 * V[2, n]
                j = end[j]


@inlined
def models_are_distorted(models):  # type: ignore[no-untyped-def]
    """Whether any k1 k2 p1 p2 counts."""
    for m in range(models.shape[0]):
        for k in range(4, 8):
            if models[m, k] != 0.0:
                return True
    return False


@inlined
def _times_basis(J, basis, Jk):  # type: ignore[no-untyped-def]
    for m in range(2):
        for k in range(basis.shape[1]):
            total = 0.0
            for n in range(8):
                total += J[m, n] * basis[n, k]
            Jk[m, k] = total


@kernel
def _accumulate(views, sightings, points, basis, inverse_squared_sigma, most_bend, damping, equations, scratch):  # type: ignore[no-untyped-def]
    S, gradient, lifted, H_cameras, H_border, H_shared, point_gradient, root = equations
    terms, J, Jk, V, column, end, W = scratch
    R, t, slot, models = views
    starts, cameras, pixels = sightings
    K, D, F = basis.shape[1], H_cameras.shape[1], H_cameras.shape[0]
    is_own, distorted, many = D > 6, models_are_distorted(models), models.shape[0] > 1
    nothing = np.empty((0, K))
    cost = 0.0
    for p in range(points.shape[0]):
        first, last = starts[p], starts[p + 1]
        H0, H1, H2, H3, H4, H5, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        W[0, :, :] = 0.0
        num = 0
        for i in range(first, last):
            c = cameras[i]
            m = c if many else 0
            q, a, b, r0, r1, p00, p01, p10, p11 = linearize_observation(R, t, c, models, m, distorted, points, p, pixels, i)
            if q == 0.0:
                cost += 1.0 / inverse_squared_sigma
                continue
            rho, g00, g01, g11, h0, h1, w00, w01, w11 = information(r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend)
            cost += rho
            s0, s1, s2 = q * (R[c, 0, 0] - a * R[c, 2, 0]), q * (R[c, 0, 1] - a * R[c, 2, 1]), q * (R[c, 0, 2] - a * R[c, 2, 2])
            t0, t1, t2 = q * (R[c, 1, 0] - b * R[c, 2, 0]), q * (R[c, 1, 1] - b * R[c, 2, 1]), q * (R[c, 1, 2] - b * R[c, 2, 2])
            x0, x1, x2 = g00 * s0 + g01 * t0, g00 * s1 + g01 * t1, g00 * s2 + g01 * t2
            y0, y1, y2 = g01 * s0 + g11 * t0, g01 * s1 + g11 * t1, g01 * s2 + g11 * t2
            H0 += s0 * x0 + t0 * y0
            H1 += s0 * x1 + t0 * y1
            H2 += s0 * x2 + t0 * y2
            H3 += s1 * x1 + t1 * y1
            H4 += s1 * x2 + t1 * y2
            H5 += s2 * x2 + t2 * y2
            g0 += h0 * s0 + h1 * t0
            g1 += h0 * s1 + h1 * t1
            g2 += h0 * s2 + h1 * t2
            f = slot[c]
            if K > 0 and (f >= 0 or not is_own):
                w = geman_mcclure(r0 * r0 + r1 * r1, inverse_squared_sigma)[1]
                model_derivatives(models, m, a, b, J)
                _times_basis(J, basis, Jk)
                if is_own:
                    _add_model(
                        Jk, q, a, b, p00, p01, p10, p11, r0, r1, w, w00, w01, w11,
                        H_cameras[f, :6, 6:], H_cameras[f, 6:, 6:], gradient[D * f + 6 : D * f + D],
                    )  # fmt: skip
                    W[num, :, :] = 0.0
                else:
                    _add_model(
                        Jk, q, a, b, p00, p01, p10, p11, r0, r1, w, w00, w01, w11,
                        H_border[f] if f >= 0 else nothing, H_shared, gradient[D * F :],
                    )  # fmt: skip
                row = num if is_own else 0
                for k in range(K):
                    x, y = w00 * Jk[0, k] + w01 * Jk[1, k], w01 * Jk[0, k] + w11 * Jk[1, k]
                    u, v = p00 * x + p10 * y, p01 * x + p11 * y
                    W[row, 0, k] += u * s0 + v * t0
                    W[row, 1, k] += u * s1 + v * t1
                    W[row, 2, k] += u * s2 + v * t2
            if f < 0:
                continue
            column[num] = D * f
            terms[num, 0], terms[num, 1], terms[num, 2] = q, a, b
            terms[num, 3], terms[num, 4], terms[num, 5] = x0, x1, x2
            terms[num, 6], terms[num, 7], terms[num, 8] = y0, y1, y2
            num += 1
            add_camera(H_cameras, f, gradient, D * f, q, a, b, g00, g01, g11, h0, h1)
        point_gradient[p, 0], point_gradient[p, 1], point_gradient[p, 2] = g0, g1, g2
        more = 1.0 + damping
        L0, L1, L2, L3, L4, L5 = inverse_root(more * H0, H1, H2, more * H3, H4, more * H5)
        if last - first < 2:
            L0, L1, L2, L3, L4, L5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        root[p, 0], root[p, 1], root[p, 2], root[p, 3], root[p, 4], root[p, 5] = L0, L1, L2, L3, L4, L5
        if L0 == 0.0:
            continue
        z0, z1, z2 = L0 * g0, L1 * g0 + L3 * g1, L2 * g0 + L4 * g1 + L5 * g2
        for i in range(num):
            _columns(terms, i, L0, L1, L2, L3, L4, L5, V, D * i)
            if is_own:
                _model_columns(W, i, L0, L1, L2, L3, L4, L5, V, D * i + 6)
            for m in range(D):
                lifted[column[i] + m] += V[0, D * i + m] * z0 + V[1, D * i + m] * z1 + V[2, D * i + m] * z2
        blocks, num_columns = num, D * num
        if K > 0 and not is_own:
            _model_columns(W, 0, L0, L1, L2, L3, L4, L5, V, num_columns)
            for m in range(K):
                n = num_columns + m
                lifted[D * F + m] += V[0, n] * z0 + V[1, n] * z1 + V[2, n] * z2
            column[num] = D * F
            blocks, num_columns = num + 1, num_columns + K
        for i in range(blocks - 1, -1, -1):
            end[i] = end[i + 1] if i + 1 < num and column[i + 1] == column[i] + D else i + 1
        _subtract_products(V, blocks, D, num_columns, column, end, S)
    return cost


def accumulate(
    views: Views, sightings: Sightings, points: Array, basis: Array, inverse_squared_sigma: float, most_bend: float, damping: float,
    equations: NormalEquations,
) -> float:  # fmt: skip
    """Fills `equations` at the present variables, H_pp damped by its diagonal; returns the cost.

    Args:
        basis: (8, K); the camera model moves by basis @ step of its K free parameters.
        inverse_squared_sigma: of the robust kernel; 0 is plain least squares.
        most_bend: see `information`.
    """
    equations.clear()
    scratch = _scratch(sightings.starts, equations.H_cameras.shape[1], basis.shape[1])
    return float(_accumulate(views, sightings, points, basis, inverse_squared_sigma, most_bend, damping, equations, scratch))


@kernel
def move_cameras(views, delta, R_new, t_new):  # type: ignore[no-untyped-def]
    """Poses after the steps delta (F, D), pose first, of the free cameras."""
    for c in range(views.R.shape[0]):
        f = views.slot[c]
        if f >= 0:
            retract(delta[f], views.R[c], views.t[c], R_new[c], t_new[c])
        else:
            R_new[c], t_new[c] = views.R[c], views.t[c]


@kernel
def move_points(views, moved, sightings, points, delta, inverse_squared_sigma, most_bend, equations, out):  # type: ignore[no-untyped-def]
    """Eq. 10: out (P, 3) = the points after the cameras went from `views` to `moved` by delta (F, D); returns the cost there."""
    R, t, slot, models = views
    starts, cameras, pixels = sightings
    distorted, many, now_distorted = models_are_distorted(models), models.shape[0] > 1, models_are_distorted(moved.models)
    is_model_free = False
    for m in range(models.shape[0]):
        for k in range(8):
            is_model_free |= models[m, k] != moved.models[m, k]
    root, point_gradient, J = equations.root, equations.point_gradient, np.empty((2, 8))
    R_new, t_new, models_new = moved.R, moved.t, moved.models
    cost = 0.0
    for p in range(points.shape[0]):
        g0, g1, g2 = point_gradient[p, 0], point_gradient[p, 1], point_gradient[p, 2]
        for i in range(starts[p], starts[p + 1]):
            c = cameras[i]
            f = slot[c]
            if f < 0 and not is_model_free:
                continue
            m = c if many else 0
            q, a, b, r0, r1, p00, p01, p10, p11 = linearize_observation(R, t, c, models, m, distorted, points, p, pixels, i)
            if q == 0.0:
                continue
            _, g00, g01, g11, _, _, w00, w01, w11 = information(r0, r1, p00, p01, p10, p11, inverse_squared_sigma, most_bend)
            h0, h1 = 0.0, 0.0
            if f >= 0:
                turn = b * delta[f, 3] - a * delta[f, 4] + q * delta[f, 2]
                da = q * delta[f, 0] + delta[f, 4] - b * delta[f, 5] - a * turn
                db = q * delta[f, 1] - delta[f, 3] + a * delta[f, 5] - b * turn
                h0, h1 = g00 * da + g01 * db, g01 * da + g11 * db
            if is_model_free:
                model_derivatives(models, m, a, b, J)
                x, y = 0.0, 0.0
                for k in range(8):
                    x += J[0, k] * (models_new[m, k] - models[m, k])
                    y += J[1, k] * (models_new[m, k] - models[m, k])
                u, v = w00 * x + w01 * y, w01 * x + w11 * y
                h0 += p00 * u + p10 * v
                h1 += p01 * u + p11 * v
            hz = a * h0 + b * h1
            g0 += q * (h0 * R[c, 0, 0] + h1 * R[c, 1, 0] - hz * R[c, 2, 0])
            g1 += q * (h0 * R[c, 0, 1] + h1 * R[c, 1, 1] - hz * R[c, 2, 1])
            g2 += q * (h0 * R[c, 0, 2] + h1 * R[c, 1, 2] - hz * R[c, 2, 2])
        L0, L1, L2, L3, L4, L5 = root[p, 0], root[p, 1], root[p, 2], root[p, 3], root[p, 4], root[p, 5]
        x, y, z = L0 * g0, L1 * g0 + L3 * g1, L2 * g0 + L4 * g1 + L5 * g2
        out[p, 0] = points[p, 0] - (L0 * x + L1 * y + L2 * z)
        out[p, 1] = points[p, 1] - (L3 * y + L4 * z)
        out[p, 2] = points[p, 2] - L5 * z
        for i in range(starts[p], starts[p + 1]):
            c = cameras[i]
            e = observation_error(R_new, t_new, c, models_new, c if many else 0, now_distorted, out, p, pixels, i)
            cost += 1.0 / inverse_squared_sigma if e == np.inf else geman_mcclure(e, inverse_squared_sigma)[0]
    return cost


@kernel
def squared_errors(views, sightings, points, out):  # type: ignore[no-untyped-def]
    """|r|² (M,) of the observations in pixels², inf behind the camera."""
    R, t, _, models = views
    starts, cameras, pixels = sightings
    distorted, many = models_are_distorted(models), models.shape[0] > 1
    for p in range(points.shape[0]):
        for i in range(starts[p], starts[p + 1]):
            c = cameras[i]
            out[i] = observation_error(R, t, c, models, c if many else 0, distorted, points, p, pixels, i)


@kernel
def squared_errors_by_row(views, obs_camera, obs_point, pixels, points, out):  # type: ignore[no-untyped-def]
    """`squared_errors` of observations in any order."""
    R, t, _, models = views
    distorted, many = models_are_distorted(models), models.shape[0] > 1
    for i in range(obs_camera.shape[0]):
        c = obs_camera[i]
        out[i] = observation_error(R, t, c, models, c if many else 0, distorted, points, obs_point[i], pixels, i)


@kernel
def scale_upper(S, scale):  # type: ignore[no-untyped-def]
    """S[i, j] *= scale[i] scale[j] in the upper triangle."""
    for i in range(S.shape[0]):
        for j in range(i, S.shape[0]):
            S[i, j] *= scale[i] * scale[j]
