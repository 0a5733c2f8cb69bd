# SPDX-License-Identifier: Apache-2.0
"""The Gauss–Newton equations with the points eliminated one by one (Eq. 9–10), and the step of points and cameras.

Variables: the free cameras' poses, six each, and K parameters that all cameras share (a border around the pose blocks).
The reduced system is S = H_cc - H_cp H_pp⁻¹ H_cpᵀ. One pass over the observations, sorted by point, linearises
them, eliminates the point while its blocks are at hand, and subtracts its part from the upper triangle of S.
"""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.reprojection import linearize_distorted, retract, squared_error_distorted
from vitamin3d.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from vitamin3d.types import Array


class Views(NamedTuple):
    """The cameras, for the kernels."""

    R: Array
    """(C, 3, 3)."""
    t: Array
    """(C, 3)."""
    slot: Array
    """(C,) int64: number among the free cameras, -1 where the pose is fixed."""
    model: Array
    """(8,) fx fy cx cy k1 k2 p1 p2."""


class Sightings(NamedTuple):
    """The observations sorted by point, for the kernels."""

    starts: Array
    """(P + 1,) int64."""
    camera: Array
    """(M,) int32, ascending within a point."""
    pixels: Array
    """(M, 2) measured pixels."""


class NormalEquations(NamedTuple):
    """F free cameras, K shared parameters, P points."""

    reduced: Array
    """(6 F + K, 6 F + K): -H_cp H_pp⁻¹ H_cpᵀ, upper triangle of blocks."""
    right: Array
    """(6 F + K,): right-hand side of the reduced system."""
    H_cameras: Array
    """(F, 6, 6), upper triangles."""
    H_border: Array
    """(F, 6, K)."""
    H_shared: Array
    """(K, K), upper triangle."""
    gradient: Array
    """(P, 3) of the points."""
    root: Array
    """(P, 6): H_pp⁻¹ = L Lᵀ, L upper triangular (00 01 02 11 12 22); zeros where the point cannot move."""

    @staticmethod
    def zeros(num_free: int, num_shared: int, num_points: int) -> "NormalEquations":
        F, K = num_free, num_shared
        shapes = ((6 * F + K, 6 * F + K), (6 * F + K,), (F, 6, 6), (F, 6, K), (K, K), (num_points, 3), (num_points, 6))
        return NormalEquations(*(np.zeros(shape) for shape in shapes))


@inlined
def inverse_root(H, L):  # type: ignore[no-untyped-def]
    """L (6,) with H⁻¹ = L Lᵀ for H (6,), the upper triangle of a 3×3 matrix, by its Cholesky factor; False where H is singular."""
    if not H[0] > 0.0:
        return False
    c00 = np.sqrt(H[0])
    c10, c20 = H[1] / c00, H[2] / c00
    d11 = H[3] - c10 * c10
    if not d11 > 1e-14 * H[3]:
        return False
    c11 = np.sqrt(d11)
    c21 = (H[4] - c20 * c10) / c11
    d22 = H[5] - c20 * c20 - c21 * c21
    if not d22 > 1e-14 * H[5]:
        return False
    c22 = np.sqrt(d22)
    L[0], L[3], L[5] = 1.0 / c00, 1.0 / c11, 1.0 / c22
    L[1] = -c10 / (c00 * c11)
    L[4] = -c21 / (c11 * c22)
    L[2] = (c10 * c21 - c20 * c11) / (c00 * c11 * c22)
    return True


@inlined
def _times_root(V, first, count, L):  # type: ignore[no-untyped-def]
    """Columns first.. of V (3, N), each a row of W = H_cp, become those of W L."""
    for n in range(first, first + count):
        x, y, z = V[0, n], V[1, n], V[2, n]
        V[0, n] = x * L[0]
        V[1, n] = x * L[1] + y * L[3]
        V[2, n] = x * L[2] + y * L[4] + z * L[5]


@inlined
def _subtract_products(V, slots, num, K, S):  # type: ignore[no-untyped-def]
    """S -= Vᵀ V at the rows and columns of `num` cameras with ascending `slots` and of the border; upper triangle of blocks.

    Neighbouring cameras have neighbouring columns, so that the inner loop runs over a whole track.
    """
    border = S.shape[0] - K
    for i in range(num):
        for m in range(6):
            row, u, v, w = 6 * slots[i] + m, V[0, 6 * i + m], V[1, 6 * i + m], V[2, 6 * i + m]
            j = i
            while j < num:
                last = j + 1
                while last < num and slots[last] == slots[last - 1] + 1:
                    last += 1
                shift = 6 * slots[j] - 6 * j
                for n in range(6 * j, 6 * last):
                    S[row, n + shift] -= u * V[0, n] + v * V[1, n] + w * V[2, n]
                j = last
            for n in range(K):
                S[row, border + n] -= u * V[0, 6 * num + n] + v * V[1, 6 * num + n] + w * V[2, 6 * num + n]
    for m in range(K):
        u, v, w = V[0, 6 * num + m], V[1, 6 * num + m], V[2, 6 * num + m]
        for n in range(m, K):
            S[border + m, border + n] -= u * V[0, 6 * num + n] + v * V[1, 6 * num + n] + w * V[2, 6 * num + n]


@inlined
def _project_model(J_model, basis, J_shared):  # type: ignore[no-untyped-def]
    for m in range(2):
        for k in range(basis.shape[1]):
            total = 0.0
            for n in range(8):
                total += J_model[m, n] * basis[n, k]
            J_shared[m, k] = total


@kernel
def accumulate(views, sightings, points, basis, squared_sigma, most_bend, damping, equations):  # type: ignore[no-untyped-def]
    """Fills `equations` (zeros) at the present variables, H_pp damped; returns the cost.

    `basis` (8, K): the camera model moves by basis @ step of the K shared parameters. Along its residual, an observation's
    weight is less by the kernel's bending (rho'' < rho' / r), which makes steps longer, but by a share of `most_bend` at most.
    """
    S, right, H_cameras, H_border, H_shared, gradient, root = equations
    K, longest = basis.shape[1], 0
    border = S.shape[0] - K
    for p in range(points.shape[0]):
        longest = max(longest, sightings.starts[p + 1] - sightings.starts[p])
    r, J, Jp, J_model, Jk = np.empty(2), np.empty((2, 6)), np.empty((2, 3)), np.empty((2, 8)), np.empty((2, K))
    V, slots, H, g, L = np.empty((3, 6 * longest + K)), np.empty(longest, np.int64), np.empty(6), np.empty(3), np.empty(6)
    shared, Q = np.empty((3, K)), np.empty((2, 3))
    cost = 0.0
    for p in range(points.shape[0]):
        first, last = sightings.starts[p], sightings.starts[p + 1]
        H[:] = 0.0
        g[:] = 0.0
        shared[:, :] = 0.0
        num = 0
        for i in range(first, last):
            c = sightings.camera[i]
            if not linearize_distorted(views.model, views.R[c], views.t[c], points[p], sightings.pixels[i], r, J, Jp, J_model):
                cost += squared_sigma
                continue
            e = r[0] * r[0] + r[1] * r[1]
            cost += geman_mcclure_cost(e, squared_sigma)
            w = geman_mcclure_weight(e, squared_sigma)
            bend = min(4.0 / (e + squared_sigma), most_bend / max(e, 1e-300))
            w00, w01, w11 = w * (1.0 - bend * r[0] * r[0]), -w * bend * r[0] * r[1], w * (1.0 - bend * r[1] * r[1])
            for n in range(3):
                g[n] += w * (Jp[0, n] * r[0] + Jp[1, n] * r[1])
                Q[0, n], Q[1, n] = w00 * Jp[0, n] + w01 * Jp[1, n], w01 * Jp[0, n] + w11 * Jp[1, n]
            H[0] += Jp[0, 0] * Q[0, 0] + Jp[1, 0] * Q[1, 0]
            H[1] += Jp[0, 0] * Q[0, 1] + Jp[1, 0] * Q[1, 1]
            H[2] += Jp[0, 0] * Q[0, 2] + Jp[1, 0] * Q[1, 2]
            H[3] += Jp[0, 1] * Q[0, 1] + Jp[1, 1] * Q[1, 1]
            H[4] += Jp[0, 1] * Q[0, 2] + Jp[1, 1] * Q[1, 2]
            H[5] += Jp[0, 2] * Q[0, 2] + Jp[1, 2] * Q[1, 2]
            f = views.slot[c]
            if K > 0:
                _project_model(J_model, basis, Jk)
                for m in range(K):
                    right[border + m] -= w * (Jk[0, m] * r[0] + Jk[1, m] * r[1])
                    x, y = w00 * Jk[0, m] + w01 * Jk[1, m], w01 * Jk[0, m] + w11 * Jk[1, m]
                    for n in range(m, K):
                        H_shared[m, n] += x * Jk[0, n] + y * Jk[1, n]
                    for n in range(3):
                        shared[n, m] += Jk[0, m] * Q[0, n] + Jk[1, m] * Q[1, n]
            if f < 0:
                continue
            repeated = num > 0 and slots[num - 1] == f
            if not repeated:
                slots[num] = f
                num += 1
            at = 6 * (num - 1)
            for m in range(6):
                right[6 * f + m] -= w * (J[0, m] * r[0] + J[1, m] * r[1])
                x, y = w00 * J[0, m] + w01 * J[1, m], w01 * J[0, m] + w11 * J[1, m]
                for n in range(m, 6):
                    H_cameras[f, m, n] += x * J[0, n] + y * J[1, n]
                for n in range(K):
                    H_border[f, m, n] += x * Jk[0, n] + y * Jk[1, n]
                for n in range(3):
                    V[n, at + m] = J[0, m] * Q[0, n] + J[1, m] * Q[1, n] + (V[n, at + m] if repeated else 0.0)
        H[0] *= 1.0 + damping
        H[3] *= 1.0 + damping
        H[5] *= 1.0 + damping
        if last - first < 2 or not inverse_root(H, L):
            root[p] = 0.0
            continue
        root[p], gradient[p] = L, g
        for m in range(K):
            for n in range(3):
                V[n, 6 * num + m] = shared[n, m]
        _times_root(V, 0, 6 * num + K, L)
        y0, y1, y2 = L[0] * g[0], L[1] * g[0] + L[3] * g[1], L[2] * g[0] + L[4] * g[1] + L[5] * g[2]
        for i in range(num):
            for m in range(6):
                n = 6 * i + m
                right[6 * slots[i] + m] += V[0, n] * y0 + V[1, n] * y1 + V[2, n] * y2
        for m in range(K):
            n = 6 * num + m
            right[border + m] += V[0, n] * y0 + V[1, n] * y1 + V[2, n] * y2
        _subtract_products(V, slots, num, K, S)
    return cost


@kernel
def move_cameras(views, delta, R_new, t_new):  # type: ignore[no-untyped-def]
    """Poses after the steps delta (F, 6) of the free cameras."""
    for c in range(views.R.shape[0]):
        f = views.slot[c]
        if f >= 0:
            retract(delta[f], views.R[c], views.t[c], R_new[c], t_new[c])
        else:
            R_new[c], t_new[c] = views.R[c], views.t[c]


@kernel
def move_points(views, moved, sightings, points, model_step, delta, squared_sigma, most_bend, gradient, root, out):  # type: ignore[no-untyped-def]
    """Eq. 10: out = the points after the steps delta (F, 6) and model_step (8,); returns the cost there, with the cameras `moved`."""
    r, J, Jp, J_model, s = np.empty(2), np.empty((2, 6)), np.empty((2, 3)), np.empty((2, 8)), np.empty(2)
    cost = 0.0
    for p in range(points.shape[0]):
        L, first, last = root[p], sightings.starts[p], sightings.starts[p + 1]
        g0, g1, g2 = gradient[p]
        for i in range(first, last):
            c = sightings.camera[i]
            if not linearize_distorted(views.model, views.R[c], views.t[c], points[p], sightings.pixels[i], r, J, Jp, J_model):
                continue
            e = r[0] * r[0] + r[1] * r[1]
            f, w = views.slot[c], geman_mcclure_weight(e, squared_sigma)
            bend = min(4.0 / (e + squared_sigma), most_bend / max(e, 1e-300))
            for m in range(2):
                s[m] = 0.0
                for n in range(8):
                    s[m] += J_model[m, n] * model_step[n]
                if f >= 0:
                    for n in range(6):
                        s[m] += J[m, n] * delta[f, n]
            along = bend * (s[0] * r[0] + s[1] * r[1])
            s[0], s[1] = w * (s[0] - along * r[0]), w * (s[1] - along * r[1])
            g0 += Jp[0, 0] * s[0] + Jp[1, 0] * s[1]
            g1 += Jp[0, 1] * s[0] + Jp[1, 1] * s[1]
            g2 += Jp[0, 2] * s[0] + Jp[1, 2] * s[1]
        x, y, z = L[0] * g0, L[1] * g0 + L[3] * g1, L[2] * g0 + L[4] * g1 + L[5] * g2
        out[p, 0] = points[p, 0] - (L[0] * x + L[1] * y + L[2] * z)
        out[p, 1] = points[p, 1] - (L[3] * y + L[4] * z)
        out[p, 2] = points[p, 2] - L[5] * z
        for i in range(first, last):
            c = sightings.camera[i]
            e = squared_error_distorted(moved.model, moved.R[c], moved.t[c], out[p], sightings.pixels[i])
            cost += squared_sigma if e == np.inf else geman_mcclure_cost(e, squared_sigma)
    return cost


@kernel
def squared_errors(views, sightings, points, out):  # type: ignore[no-untyped-def]
    """|r|² (M,) of the observations in pixels², inf behind the camera."""
    for p in range(points.shape[0]):
        for i in range(sightings.starts[p], sightings.starts[p + 1]):
            c = sightings.camera[i]
            out[i] = squared_error_distorted(views.model, views.R[c], views.t[c], points[p], sightings.pixels[i])
