# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment (Eq. 6): the subspace Gauss–Newton method (Eq. 11–12) and the Schur complement (Eq. 9–10).

Both minimise the same objective with the same derivatives (`geometry/reprojection.py`). Subspace Gauss–Newton solves
for one block at a time, 6×6 for a camera and 3×3 for a point, everything else fixed and relinearised, so that no large
matrix is built. It lowers the cost quickly and then crawls along directions in which cameras and points move together;
those are what the Schur complement is for.
"""

import dataclasses

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.reprojection import linearize, retract, squared_error
from vitamin3d.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from vitamin3d.types import Array, BundleReport

BLOCK_DAMPING = 1e-9
STEP_HALVINGS = 3
FIRST_DAMPING = 1e-4
MAX_DAMPING = 1e8
POINTS_PER_BLOCK = 256
"""Points whose part of the reduced camera system is accumulated by one matrix product."""


@inlined
def _robust(e, squared_sigma):  # type: ignore[no-untyped-def]
    """Geman–McClure of |r|²; a point behind the camera costs what the farthest outlier does."""
    return squared_sigma if e == np.inf else geman_mcclure_cost(e, squared_sigma)


@kernel
def _total_cost(intrinsics, R, t, points, obs_camera, obs_point, obs_pixels, squared_sigma):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(obs_camera.shape[0]):
        c = obs_camera[i]
        total += _robust(squared_error(intrinsics, R[c], t[c], points[obs_point[i]], obs_pixels[i]), squared_sigma)
    return total


@kernel
def _squared_errors(intrinsics, R, t, points, obs_camera, obs_point, obs_pixels, out):  # type: ignore[no-untyped-def]
    for i in range(obs_camera.shape[0]):
        c = obs_camera[i]
        out[i] = squared_error(intrinsics, R[c], t[c], points[obs_point[i]], obs_pixels[i])


@inlined
def _camera_cost(intrinsics, R, t, points, obs_point, obs_pixels, first, last, squared_sigma):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(first, last):
        total += _robust(squared_error(intrinsics, R, t, points[obs_point[i]], obs_pixels[i]), squared_sigma)
    return total


@kernel
def _sweep_cameras(intrinsics, R, t, is_free, starts, points, obs_point, obs_pixels, squared_sigma):  # type: ignore[no-untyped-def]
    """Eq. 11 for each free camera: a 6×6 Gauss–Newton step, halved while the cost rises, else not taken."""
    r, J, J_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    H, g, R_new, t_new = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty(3)
    for c in range(R.shape[0]):
        first, last = starts[c], starts[c + 1]
        if not is_free[c] or last - first < 6:
            continue
        H[:, :] = 0.0
        g[:] = 0.0
        before = 0.0
        for i in range(first, last):
            if not linearize(intrinsics, R[c], t[c], points[obs_point[i]], obs_pixels[i], r, J, J_point):
                before += squared_sigma
                continue
            e = r[0] * r[0] + r[1] * r[1]
            before += geman_mcclure_cost(e, squared_sigma)
            w = geman_mcclure_weight(e, squared_sigma)
            for m in range(6):
                g[m] += w * (J[0, m] * r[0] + J[1, m] * r[1])
                for n in range(m, 6):
                    H[m, n] += w * (J[0, m] * J[0, n] + J[1, m] * J[1, n])
        for m in range(6):
            H[m, m] += BLOCK_DAMPING * H[m, m] + 1e-12
            for n in range(m):
                H[m, n] = H[n, m]
        delta = -np.linalg.solve(H, g)
        for _ in range(STEP_HALVINGS):
            retract(delta, R[c], t[c], R_new, t_new)
            if _camera_cost(intrinsics, R_new, t_new, points, obs_point, obs_pixels, first, last, squared_sigma) <= before:
                R[c], t[c] = R_new, t_new
                break
            delta *= 0.5


@inlined
def _solve_3x3(H, g, x):  # type: ignore[no-untyped-def]
    """x = -H⁻¹ g for a symmetric H (3, 3) given by its upper triangle; False where it is singular."""
    a, b, c, d, e, f = H[0, 0], H[0, 1], H[0, 2], H[1, 1], H[1, 2], H[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    if not det > 1e-14 * a * d * f:
        return False
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    x[0] = -(A * g[0] + B * g[1] + C * g[2]) / det
    x[1] = -(B * g[0] + D * g[1] + E * g[2]) / det
    x[2] = -(C * g[0] + E * g[1] + F * g[2]) / det
    return True


@inlined
def _point_cost(intrinsics, R, t, X, rows, obs_camera, obs_pixels, squared_sigma):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in rows:
        c = obs_camera[i]
        total += _robust(squared_error(intrinsics, R[c], t[c], X, obs_pixels[i]), squared_sigma)
    return total


@kernel
def _sweep_points(intrinsics, R, t, points, point_starts, point_order, obs_camera, obs_pixels, squared_sigma):  # type: ignore[no-untyped-def]
    """Eq. 12 for each point with two observations: a 3×3 Gauss–Newton step, halved while the cost rises."""
    r, J_pose, J = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    H, g, delta, X = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for p in range(points.shape[0]):
        rows = point_order[point_starts[p] : point_starts[p + 1]]
        if rows.shape[0] < 2:
            continue
        H[:, :] = 0.0
        g[:] = 0.0
        before = 0.0
        for i in rows:
            c = obs_camera[i]
            if not linearize(intrinsics, R[c], t[c], points[p], obs_pixels[i], r, J_pose, J):
                before += squared_sigma
                continue
            e = r[0] * r[0] + r[1] * r[1]
            before += geman_mcclure_cost(e, squared_sigma)
            w = geman_mcclure_weight(e, squared_sigma)
            for m in range(3):
                g[m] += w * (J[0, m] * r[0] + J[1, m] * r[1])
                for n in range(m, 3):
                    H[m, n] += w * (J[0, m] * J[0, n] + J[1, m] * J[1, n])
        for m in range(3):
            H[m, m] *= 1.0 + BLOCK_DAMPING
        if not _solve_3x3(H, g, delta):
            continue
        for _ in range(STEP_HALVINGS):
            X[:] = points[p] + delta
            if _point_cost(intrinsics, R, t, X, rows, obs_camera, obs_pixels, squared_sigma) <= before:
                points[p] = X
                break
            delta *= 0.5


@inlined
def _inverse_root_3x3(H, L):  # type: ignore[no-untyped-def]
    """L upper triangular (3, 3) with H⁻¹ = L Lᵀ, by the Cholesky factor of H; False where H is singular."""
    if not H[0, 0] > 0.0:
        return False
    c00 = np.sqrt(H[0, 0])
    c10, c20 = H[1, 0] / c00, H[2, 0] / c00
    d11 = H[1, 1] - c10 * c10
    if not d11 > 1e-14 * H[1, 1]:
        return False
    c11 = np.sqrt(d11)
    c21 = (H[2, 1] - c20 * c10) / c11
    d22 = H[2, 2] - c20 * c20 - c21 * c21
    if not d22 > 1e-14 * H[2, 2]:
        return False
    c22 = np.sqrt(d22)
    L[0, 0], L[1, 1], L[2, 2] = 1.0 / c00, 1.0 / c11, 1.0 / c22
    L[0, 1] = -c10 / (c00 * c11)
    L[1, 2] = -c21 / (c11 * c22)
    L[0, 2] = (c10 * c21 - c20 * c11) / (c00 * c11 * c22)
    L[1, 0] = L[2, 0] = L[2, 1] = 0.0
    return True


@kernel
def _linearize_points(  # type: ignore[no-untyped-def]
    intrinsics, R, t, free_index, points, point_starts, point_order, obs_camera, obs_pixels,
    squared_sigma, damping, block, block_row, H_cameras, b, W, L, g_points, A,
):  # fmt: skip
    """The points `block` of Eq. 9: camera blocks H_cameras (F, 6, 6) and b (F, 6); per observation W = H_cp (6, 3); per point
    its gradient g, H_pp⁻¹ = L Lᵀ, and the columns W L of A, whose rows 6 block_row[f].. are camera f: A Aᵀ is H_cp H_pp⁻¹ H_cpᵀ."""
    r, J, Jp, H = np.empty(2), np.empty((2, 6)), np.empty((2, 3)), np.empty((3, 3))
    A[:, :] = 0.0
    for k in range(block.shape[0]):
        p = block[k]
        rows = point_order[point_starts[p] : point_starts[p + 1]]
        H[:, :] = 0.0
        g_points[p, :] = 0.0
        for i in rows:
            c = obs_camera[i]
            f = free_index[c]
            W[i] = 0.0
            if not linearize(intrinsics, R[c], t[c], points[p], obs_pixels[i], r, J, Jp):
                continue
            w = geman_mcclure_weight(r[0] * r[0] + r[1] * r[1], squared_sigma)
            for m in range(3):
                g_points[p, m] += w * (Jp[0, m] * r[0] + Jp[1, m] * r[1])
                for n in range(3):
                    H[m, n] += w * (Jp[0, m] * Jp[0, n] + Jp[1, m] * Jp[1, n])
            if f < 0:
                continue
            for m in range(6):
                b[f, m] -= w * (J[0, m] * r[0] + J[1, m] * r[1])
                for n in range(6):
                    H_cameras[f, m, n] += w * (J[0, m] * J[0, n] + J[1, m] * J[1, n])
                for n in range(3):
                    W[i, m, n] = w * (J[0, m] * Jp[0, n] + J[1, m] * Jp[1, n])
        for m in range(3):
            H[m, m] *= 1.0 + damping
        if rows.shape[0] < 2 or not _inverse_root_3x3(H, L[p]):
            L[p] = 0.0
            continue
        for i in rows:
            f = free_index[obs_camera[i]]
            if f >= 0:
                row = 6 * block_row[f]
                for m in range(6):
                    A[row + m, 3 * k] += W[i, m, 0] * L[p, 0, 0]
                    A[row + m, 3 * k + 1] += W[i, m, 0] * L[p, 0, 1] + W[i, m, 1] * L[p, 1, 1]
                    A[row + m, 3 * k + 2] += W[i, m, 0] * L[p, 0, 2] + W[i, m, 1] * L[p, 1, 2] + W[i, m, 2] * L[p, 2, 2]


@kernel
def _back_substitute(delta, free_index, points, point_starts, point_order, obs_camera, W, L, g_points, out):  # type: ignore[no-untyped-def]
    """Eq. 10: the points' steps from the cameras' steps delta (F, 6); out = points + steps."""
    rhs = np.empty(3)
    for p in range(points.shape[0]):
        rhs[:] = g_points[p]
        for k in range(point_starts[p], point_starts[p + 1]):
            i = point_order[k]
            f = free_index[obs_camera[i]]
            if f >= 0:
                for n in range(3):
                    for m in range(6):
                        rhs[n] += W[i, m, n] * delta[f, m]
        x = L[p, 0, 0] * rhs[0]
        y = L[p, 0, 1] * rhs[0] + L[p, 1, 1] * rhs[1]
        z = L[p, 0, 2] * rhs[0] + L[p, 1, 2] * rhs[1] + L[p, 2, 2] * rhs[2]
        out[p, 0] = points[p, 0] - (L[p, 0, 0] * x + L[p, 0, 1] * y + L[p, 0, 2] * z)
        out[p, 1] = points[p, 1] - (L[p, 1, 1] * y + L[p, 1, 2] * z)
        out[p, 2] = points[p, 2] - L[p, 2, 2] * z


@kernel
def _retract_all(delta, free_index, R, t, R_new, t_new):  # type: ignore[no-untyped-def]
    for c in range(R.shape[0]):
        if free_index[c] >= 0:
            retract(delta[free_index[c]], R[c], t[c], R_new[c], t_new[c])
        else:
            R_new[c], t_new[c] = R[c], t[c]


class _State:
    """The variables of a problem as contiguous arrays, and its constants."""

    def __init__(self, problem: BundleProblem, camera: Camera, sigma_px: float) -> None:
        self.problem = problem
        self.intrinsics = camera.intrinsics
        self.squared_sigma = sigma_px**2
        self.R = np.ascontiguousarray(problem.T_cam_world[:, :3, :3])
        self.t = np.ascontiguousarray(problem.T_cam_world[:, :3, 3])
        self.points = np.array(problem.points_world)
        self.camera_starts = np.searchsorted(problem.obs_camera, np.arange(len(self.R) + 1))

    def cost(self, R: Array, t: Array, points: Array) -> float:
        p = self.problem
        return float(_total_cost(self.intrinsics, R, t, points, p.obs_camera, p.obs_point, p.obs_pixels, self.squared_sigma))

    def point_blocks(self, free_index: Array) -> list[tuple[Array, Array]]:
        """Points in blocks that share cameras, by the first that sees them, each with the free cameras (by index) that see it."""
        p = self.problem
        seen = p.point_starts[1:] > p.point_starts[:-1]
        first = np.full(len(self.points), len(self.R))
        first[seen] = p.obs_camera[p.point_order[p.point_starts[:-1][seen]]]
        order = np.argsort(first, kind="stable")
        block_of_point = np.empty(len(order), np.int64)
        block_of_point[order] = np.arange(len(order)) // POINTS_PER_BLOCK
        is_free = free_index[p.obs_camera] >= 0
        sees = np.zeros((len(order) // POINTS_PER_BLOCK + 1, int(free_index.max(initial=-1)) + 1), np.bool_)
        sees[block_of_point[p.obs_point[is_free]], free_index[p.obs_camera[is_free]]] = True
        blocks = [order[k : k + POINTS_PER_BLOCK] for k in range(0, len(order), POINTS_PER_BLOCK)]
        return [(block, np.flatnonzero(sees[k])) for k, block in enumerate(blocks)]

    def result(self) -> BundleProblem:
        U, _, Vt = np.linalg.svd(self.R)
        poses = np.array(self.problem.T_cam_world)
        poses[:, :3, :3], poses[:, :3, 3] = U @ Vt, self.t
        poses[~self.problem.camera_is_free] = self.problem.T_cam_world[~self.problem.camera_is_free]
        return dataclasses.replace(self.problem, T_cam_world=poses, points_world=self.points)


def squared_reprojection_errors(problem: BundleProblem, camera: Camera) -> Array:
    """|r|² (M,) of all observations in pixels², inf behind the camera."""
    state, out = _State(problem, camera, 1.0), np.empty(len(problem.obs_camera))
    p = problem
    _squared_errors(state.intrinsics, state.R, state.t, state.points, p.obs_camera, p.obs_point, p.obs_pixels, out)
    return out


def _report(solved: BundleProblem, camera: Camera, costs: list[float], converged: bool, sigma_px: float) -> BundleReport:
    e = squared_reprojection_errors(solved, camera)
    near = e < (3.0 * sigma_px) ** 2
    rmse = float(np.sqrt(e[near].mean())) if near.any() else float("nan")
    return BundleReport(np.array(costs), converged, len(e), rmse)


def adjust_subspace(
    problem: BundleProblem, camera: Camera, sigma_px: float, sweeps: int, relative_gain: float = 1e-5
) -> tuple[BundleProblem, BundleReport]:
    """Subspace Gauss–Newton: sweeps over all free cameras (Eq. 11) and then all points (Eq. 12); the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each sweep; it ends when a sweep gains less than relative_gain.
    """
    s, p = _State(problem, camera, sigma_px), problem
    costs = [s.cost(s.R, s.t, s.points)]
    for _ in range(sweeps):
        _sweep_cameras(s.intrinsics, s.R, s.t, p.camera_is_free, s.camera_starts, s.points, p.obs_point, p.obs_pixels, s.squared_sigma)
        _sweep_points(s.intrinsics, s.R, s.t, s.points, p.point_starts, p.point_order, p.obs_camera, p.obs_pixels, s.squared_sigma)
        costs.append(s.cost(s.R, s.t, s.points))
        if costs[-2] - costs[-1] <= relative_gain * costs[-2]:
            break
    solved = s.result()
    return solved, _report(solved, camera, costs, costs[-2] - costs[-1] <= relative_gain * costs[-2] if sweeps else False, sigma_px)


def adjust_schur(
    problem: BundleProblem, camera: Camera, sigma_px: float, iterations: int, relative_gain: float = 1e-5
) -> tuple[BundleProblem, BundleReport]:
    """Levenberg–Marquardt with the points eliminated (Eq. 9–10); the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each accepted or refused step.
    """
    s = _State(problem, camera, sigma_px)
    free_index = np.where(problem.camera_is_free, np.cumsum(problem.camera_is_free) - 1, -1)
    costs, damping, converged = [s.cost(s.R, s.t, s.points)], FIRST_DAMPING, False
    for _ in range(iterations):
        R, t, points = _schur_step(s, free_index, damping)
        cost = s.cost(R, t, points)
        accepted = cost <= costs[-1]
        costs.append(min(cost, costs[-1]))
        if accepted:
            s.R, s.t, s.points, damping = R, t, points, max(1e-8, 0.1 * damping)
            converged = costs[-2] - cost <= relative_gain * cost
        else:
            damping *= 10.0
        if converged or damping > MAX_DAMPING:
            break
    solved = s.result()
    return solved, _report(solved, camera, costs, converged, sigma_px)


def _schur_step(s: _State, free_index: Array, damping: float) -> tuple[Array, Array, Array]:
    """One damped step of all variables: new R (C, 3, 3), t (C, 3), points (P, 3)."""
    p, num_points = s.problem, len(s.points)
    F = int(free_index.max(initial=-1)) + 1
    H_cameras, b, reduced = np.zeros((F, 6, 6)), np.zeros((F, 6)), np.zeros((6 * F, 6 * F))
    W, L, g_points = np.empty((len(p.obs_camera), 6, 3)), np.empty((num_points, 3, 3)), np.empty((num_points, 3))
    for block, cameras in s.point_blocks(free_index):
        block_row = np.full(F, -1)
        block_row[cameras] = np.arange(len(cameras))
        A = np.empty((6 * len(cameras), 3 * len(block)))
        _linearize_points(
            s.intrinsics, s.R, s.t, free_index, s.points, p.point_starts, p.point_order, p.obs_camera, p.obs_pixels,
            s.squared_sigma, damping, block, block_row, H_cameras, b, W, L, g_points, A,
        )  # fmt: skip
        rows = (6 * cameras[:, None] + np.arange(6)).ravel()
        reduced[np.ix_(rows, rows)] -= A @ A.T
        b[cameras] += (A @ np.einsum("pji,pj->pi", L[block], g_points[block]).ravel()).reshape(-1, 6)
    delta = _solve_cameras(reduced, H_cameras, b, damping)
    R, t, points = np.empty_like(s.R), np.empty_like(s.t), np.empty_like(s.points)
    _retract_all(delta, free_index, s.R, s.t, R, t)
    _back_substitute(delta, free_index, s.points, p.point_starts, p.point_order, p.obs_camera, W, L, g_points, points)
    return R, t, points


def _solve_cameras(reduced: Array, H_cameras: Array, b: Array, damping: float) -> Array:
    """Steps (F, 6) of the cameras (Eq. 9); `reduced` (6 F, 6 F) is -H_cp H_pp⁻¹ H_cpᵀ, H_cameras (F, 6, 6) the blocks of H_cc."""
    F = len(b)
    for f in range(F):
        block = H_cameras[f] + damping * np.diag(np.diag(H_cameras[f]))
        reduced[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] += block
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-12))
    scaled = reduced * scale[:, None] * scale[None, :] + 1e-12 * np.eye(6 * F)
    return np.asarray((scale * np.linalg.solve(scaled, scale * b.ravel())).reshape(F, 6)) if F else np.zeros((0, 6))


def adjust_bundle(problem: BundleProblem, camera: Camera, config: BundleAdjustmentConfig) -> tuple[BundleProblem, BundleReport]:
    """The window's adjustment at a keyframe, by the solver that the settings name."""
    if config.keyframe_solver == "schur":
        return adjust_schur(problem, camera, config.sigma_px, config.keyframe_iterations, config.relative_gain)
    return adjust_subspace(problem, camera, config.sigma_px, config.keyframe_iterations, config.relative_gain)
