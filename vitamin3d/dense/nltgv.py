# SPDX-License-Identifier: Apache-2.0
"""NLTGV²-L1 denoising of inverse depth on the triangulation (Greene and Roy, "FLaME", ICCV 2017; Sec. 4.2 of the paper).

    min over xi, w of  sum_edges alpha |xi_i - xi_j - <w_i, u_i - u_j>| + beta ||w_i - w_j||_1  +  lambda sum_v omega_v |xi_v - z_v|

with alpha = 1 / ||u_i - u_j||: every vertex has an inverse depth xi and a slope w, piecewise planes cost nothing, and a
plane in the world is a plane in inverse depth. It has the form `min_x F(K x) + G(x)` and is solved by the primal-dual
algorithm of Chambolle and Pock with over-relaxation 1 and the diagonal step sizes of Pock and Chambolle (2011),
tau_v = s / sum_e |K_ev| and sigma_e = 1 / (s sum_v |K_ev|). Their ratio s leaves the minimum where it is; with far smaller
primal than dual steps (s = 0.03 instead of 1) an eighth of the iterations comes as near to it.
"""

from dataclasses import dataclass, replace

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import NltgvConfig
from vitamin3d.types import Array, ImageMesh


@dataclass(frozen=True)
class NltgvProblem:
    """The problem without units: pixels divided by `pixel_unit`, inverse depths by their mean."""

    edges: Array
    """(E, 2) int32, vertices i and j."""
    offsets: Array
    """(E, 2) u_i - u_j."""
    data: Array
    """(V,) z."""
    data_weights: Array
    """(V,) lambda omega."""
    beta: float
    primal_share: float
    """s, the ratio of the steps."""

    @property
    def alpha(self) -> Array:
        """(E,)."""
        return np.asarray(1.0 / np.linalg.norm(self.offsets, axis=1))


@dataclass(frozen=True)
class Denoised:
    """What `denoise` found."""

    mesh: ImageMesh
    """The input with new inverse depths."""
    slopes: Array
    """(V, 2) gradient of inverse depth at each vertex, per map unit and pixel."""
    energies: Array
    """(2,) `objective` before and after, without units."""


def denoise(mesh: ImageMesh, config: NltgvConfig) -> Denoised:
    """The mesh with its inverse depths made piecewise planar."""
    unit = float(mesh.inverse_depth.mean())
    problem = normalized_problem(mesh, config)
    start = np.column_stack([problem.data, vertex_slopes(mesh) * config.pixel_unit / unit])
    state = solve(problem, start, config.iterations if config.enabled else 0)
    energies = np.array([objective(problem, start), objective(problem, state)])
    smooth = np.maximum(state[:, 0], MIN_RELATIVE_INVERSE_DEPTH) * unit
    return Denoised(replace(mesh, inverse_depth=smooth), state[:, 1:] * unit / config.pixel_unit, energies)


MIN_RELATIVE_INVERSE_DEPTH = 1e-3
"""Nothing lies farther than this fraction of the mean inverse depth says; keeps depths finite and positive."""


def normalized_problem(mesh: ImageMesh, config: NltgvConfig) -> NltgvProblem:
    """The problem of a mesh in the units of `NltgvProblem`."""
    pixels = mesh.pixels / config.pixel_unit
    i, j = mesh.edges[:, 0], mesh.edges[:, 1]
    data = mesh.inverse_depth / mesh.inverse_depth.mean()
    weights = config.data_weight * config.full_deviation / mesh.relative_deviation
    return NltgvProblem(mesh.edges, pixels[i] - pixels[j], data, weights, config.slope_weight, config.primal_share)


@kernel
def _objective(edges, offsets, beta, data, weights, state):  # type: ignore[no-untyped-def]
    energy = 0.0
    for e in range(edges.shape[0]):
        i, j, du, dv = edges[e, 0], edges[e, 1], offsets[e, 0], offsets[e, 1]
        bend = abs(state[i, 0] - state[j, 0] - state[i, 1] * du - state[i, 2] * dv) / np.sqrt(du * du + dv * dv)
        energy += bend + beta * (abs(state[i, 1] - state[j, 1]) + abs(state[i, 2] - state[j, 2]))
    for v in range(data.shape[0]):
        energy += weights[v] * abs(state[v, 0] - data[v])
    return energy


def objective(problem: NltgvProblem, state: Array) -> float:
    """The energy that `solve` minimises, at `state` (V, 3) `[xi, w_u, w_v]`."""
    return float(_objective(problem.edges, problem.offsets, problem.beta, problem.data, problem.data_weights, state))


@kernel
def _chambolle_pock(edges, rows, beta, rate, tau, data, shrinkage, iterations, x, x_bar, dual, gradient):  # type: ignore[no-untyped-def]
    """`rows` (E, 4): alpha, alpha du, alpha dv, sigma; `rate` is sigma beta of the slopes. `x`, `x_bar`, `gradient` (V, 3) and
    `dual` (E, 3) change."""
    for _ in range(iterations):
        gradient[:] = 0.0
        for e in range(edges.shape[0]):  # dual ascent, projection on |q| <= 1, and K^T q
            i, j = edges[e, 0], edges[e, 1]
            a, au, av = rows[e, 0], rows[e, 1], rows[e, 2]
            xi_i, u_i, v_i = x_bar[i, 0], x_bar[i, 1], x_bar[i, 2]
            bend = a * (xi_i - x_bar[j, 0]) - au * u_i - av * v_i
            q1 = min(max(dual[e, 0] + rows[e, 3] * bend, -1.0), 1.0)
            q2 = min(max(dual[e, 1] + rate * (u_i - x_bar[j, 1]), -1.0), 1.0)
            q3 = min(max(dual[e, 2] + rate * (v_i - x_bar[j, 2]), -1.0), 1.0)
            dual[e, 0], dual[e, 1], dual[e, 2] = q1, q2, q3
            gradient[i, 0] += a * q1
            gradient[j, 0] -= a * q1
            gradient[i, 1] += beta * q2 - au * q1
            gradient[j, 1] -= beta * q2
            gradient[i, 2] += beta * q3 - av * q1
            gradient[j, 2] -= beta * q3
        for v in range(x.shape[0]):  # primal descent, shrinking xi towards the data, and over-relaxation
            residual = x[v, 0] - tau[v, 0] * gradient[v, 0] - data[v]
            shrunk = residual - min(max(residual, -shrinkage[v]), shrinkage[v])
            xi, wu, wv = data[v] + shrunk, x[v, 1] - tau[v, 1] * gradient[v, 1], x[v, 2] - tau[v, 2] * gradient[v, 2]
            x_bar[v, 0], x_bar[v, 1], x_bar[v, 2] = 2.0 * xi - x[v, 0], 2.0 * wu - x[v, 1], 2.0 * wv - x[v, 2]
            x[v, 0], x[v, 1], x[v, 2] = xi, wu, wv


def solve(problem: NltgvProblem, start: Array, iterations: int) -> Array:
    """State (V, 3) `[xi, w_u, w_v]` after so many iterations from `start` (V, 3)."""
    rows, tau = _preconditioned(problem)
    x = np.array(start, np.float64)
    dual = np.zeros((len(problem.edges), 3))
    shrinkage = tau[:, 0] * problem.data_weights
    rate = 0.5 / problem.primal_share  # a slope's row of K is beta and -beta
    _chambolle_pock(problem.edges, rows, problem.beta, rate, tau, problem.data, shrinkage, iterations, x, x.copy(), dual, np.empty_like(x))
    return x


def _preconditioned(problem: NltgvProblem) -> tuple[Array, Array]:
    """Rows (E, 4) of K for the kernel with their sigma, and tau (V, 3)."""
    alpha, count = problem.alpha, len(problem.data)
    slopes = alpha[:, None] * problem.offsets
    sigma = 1.0 / (problem.primal_share * (2.0 * alpha + np.abs(slopes).sum(axis=1)))
    i, ends = problem.edges[:, 0], problem.edges.ravel()
    along = np.stack([np.bincount(i, np.abs(slopes[:, k]), count) for k in range(2)], axis=1)
    degree = problem.beta * np.bincount(ends, minlength=count)
    columns = np.column_stack([np.bincount(ends, np.repeat(alpha, 2), count), along + degree[:, None]])
    return np.column_stack([alpha, slopes, sigma]), problem.primal_share / np.maximum(columns, 1e-12)


def vertex_slopes(mesh: ImageMesh) -> Array:
    """Gradient (V, 2) of inverse depth at each vertex, per pixel: the mean over its triangles, weighted by area."""
    a, b, c = (mesh.pixels[mesh.triangles[:, k]] for k in range(3))
    za, zb, zc = (mesh.inverse_depth[mesh.triangles[:, k]] for k in range(3))
    ab, ac, zab, zac = b - a, c - a, zb - za, zc - za
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    scaled = np.stack([zab * ac[:, 1] - zac * ab[:, 1], zac * ab[:, 0] - zab * ac[:, 0]], axis=1) * np.sign(area)[:, None]
    corners, count = mesh.triangles.ravel(), len(mesh.pixels)
    sums = np.stack([np.bincount(corners, np.repeat(scaled[:, k], 3), count) for k in range(2)], axis=1)
    return sums / np.maximum(np.bincount(corners, np.repeat(np.abs(area), 3), count), 1e-12)[:, None]
