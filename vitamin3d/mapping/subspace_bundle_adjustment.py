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
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.reprojection import linearize, retract, squared_error
from vitamin3d.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from vitamin3d.mapping.window_selection import BundleProblem
from vitamin3d.types import Array, BundleReport

BLOCK_DAMPING = 1e-9
STEP_HALVINGS = 3
FIRST_DAMPING = 1e-4
MAX_DAMPING = 1e8
RELATIVE_GAIN = 1e-5


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


@kernel
def _reduced_system(  # type: ignore[no-untyped-def]
    intrinsics, R, t, free_index, points, point_starts, point_order, obs_camera, obs_pixels,
    squared_sigma, damping, S, b, W, H_inverse, g_points,
):  # fmt: skip
    """Eq. 9: the Schur complement S (F, F, 6, 6), upper blocks, and its right side b (F, 6); W, H⁻¹ and g for Eq. 10."""
    r, J, Jp = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    H, Y, unit, column = np.empty((3, 3)), np.empty((6, 3)), np.empty(3), np.empty(3)
    for p in range(points.shape[0]):
        rows = point_order[point_starts[p] : point_starts[p + 1]]
        is_fixed = rows.shape[0] < 2
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
                    S[f, f, m, n] += w * (J[0, m] * J[0, n] + J[1, m] * J[1, n])
                for n in range(3):
                    W[i, m, n] = w * (J[0, m] * Jp[0, n] + J[1, m] * Jp[1, n])
            S_scale = damping * w
            for m in range(6):
                S[f, f, m, m] += S_scale * (J[0, m] * J[0, m] + J[1, m] * J[1, m])
        H_inverse[p] = 0.0
        if is_fixed:
            g_points[p, :] = 0.0
            continue
        for m in range(3):
            H[m, m] *= 1.0 + damping
        for m in range(3):
            unit[:] = 0.0
            unit[m] = -1.0
            if _solve_3x3(H, unit, column):
                H_inverse[p, m] = column
        for i_at in range(rows.shape[0]):
            i = rows[i_at]
            f = free_index[obs_camera[i]]
            if f < 0:
                continue
            for m in range(6):
                for n in range(3):
                    Y[m, n] = W[i, m, 0] * H_inverse[p, 0, n] + W[i, m, 1] * H_inverse[p, 1, n] + W[i, m, 2] * H_inverse[p, 2, n]
                b[f, m] += Y[m, 0] * g_points[p, 0] + Y[m, 1] * g_points[p, 1] + Y[m, 2] * g_points[p, 2]
            for j_at in range(i_at, rows.shape[0]):
                j = rows[j_at]
                f2 = free_index[obs_camera[j]]
                if f2 < 0:
                    continue
                block = S[f, f2]
                for m in range(6):
                    for n in range(6):
                        block[m, n] -= Y[m, 0] * W[j, n, 0] + Y[m, 1] * W[j, n, 1] + Y[m, 2] * W[j, n, 2]


@kernel
def _back_substitute(delta, free_index, points, point_starts, point_order, obs_camera, W, H_inverse, g_points, out):  # type: ignore[no-untyped-def]
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
        for n in range(3):
            out[p, n] = points[p, n] - (H_inverse[p, n, 0] * rhs[0] + H_inverse[p, n, 1] * rhs[1] + H_inverse[p, n, 2] * rhs[2])


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


def adjust_subspace(problem: BundleProblem, camera: Camera, sigma_px: float, sweeps: int) -> tuple[BundleProblem, BundleReport]:
    """Subspace Gauss–Newton: sweeps over all free cameras (Eq. 11) and then all points (Eq. 12); the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each sweep.
    """
    s, p = _State(problem, camera, sigma_px), problem
    costs = [s.cost(s.R, s.t, s.points)]
    for _ in range(sweeps):
        _sweep_cameras(s.intrinsics, s.R, s.t, p.camera_is_free, s.camera_starts, s.points, p.obs_point, p.obs_pixels, s.squared_sigma)
        _sweep_points(s.intrinsics, s.R, s.t, s.points, p.point_starts, p.point_order, p.obs_camera, p.obs_pixels, s.squared_sigma)
        costs.append(s.cost(s.R, s.t, s.points))
        if costs[-2] - costs[-1] <= RELATIVE_GAIN * costs[-2]:
            break
    solved = s.result()
    return solved, _report(solved, camera, costs, costs[-2] - costs[-1] <= RELATIVE_GAIN * costs[-2] if sweeps else False, sigma_px)


def adjust_schur(problem: BundleProblem, camera: Camera, sigma_px: float, iterations: int) -> tuple[BundleProblem, BundleReport]:
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
            converged = costs[-2] - cost <= RELATIVE_GAIN * cost
        else:
            damping *= 10.0
        if converged or damping > MAX_DAMPING:
            break
    solved = s.result()
    return solved, _report(solved, camera, costs, converged, sigma_px)


def _schur_step(s: _State, free_index: Array, damping: float) -> tuple[Array, Array, Array]:
    """One damped step of all variables: new R (C, 3, 3), t (C, 3), points (P, 3)."""
    p, F = s.problem, int(free_index.max(initial=-1)) + 1
    S, b = np.zeros((F, F, 6, 6)), np.zeros((F, 6))
    W, H_inverse, g_points = np.empty((len(p.obs_camera), 6, 3)), np.empty((len(s.points), 3, 3)), np.empty((len(s.points), 3))
    _reduced_system(
        s.intrinsics, s.R, s.t, free_index, s.points, p.point_starts, p.point_order, p.obs_camera, p.obs_pixels,
        s.squared_sigma, damping, S, b, W, H_inverse, g_points,
    )  # fmt: skip
    delta = _solve_cameras(S, b)
    R, t, points = np.empty_like(s.R), np.empty_like(s.t), np.empty_like(s.points)
    _retract_all(delta, free_index, s.R, s.t, R, t)
    _back_substitute(delta, free_index, s.points, p.point_starts, p.point_order, p.obs_camera, W, H_inverse, g_points, points)
    return R, t, points


def _solve_cameras(S: Array, b: Array) -> Array:
    """Steps (F, 6) of the cameras from the upper blocks S (F, F, 6, 6) and b (F, 6)."""
    F = len(b)
    matrix = S.transpose(0, 2, 1, 3).reshape(6 * F, 6 * F)
    upper = np.triu(matrix)
    matrix = upper + np.triu(matrix, 1).T
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    scaled = matrix * scale[:, None] * scale[None, :] + 1e-12 * np.eye(6 * F)
    return np.asarray((scale * np.linalg.solve(scaled, scale * b.ravel())).reshape(F, 6)) if F else np.zeros((0, 6))


def adjust_bundle(problem: BundleProblem, camera: Camera, config: BundleAdjustmentConfig) -> tuple[BundleProblem, BundleReport]:
    """The window's adjustment at a keyframe, by the solver that the settings name."""
    if config.keyframe_solver == "schur":
        return adjust_schur(problem, camera, config.sigma_px, config.keyframe_iterations)
    return adjust_subspace(problem, camera, config.sigma_px, config.keyframe_iterations)
