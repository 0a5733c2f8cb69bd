# SPDX-License-Identifier: Apache-2.0
"""Localisation of a frame against the map: P3P RANSAC, then a robust refinement of the pose (Sec. 5.1)."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import LocalizationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.p3p import p3p_ransac
from vitamin3d.geometry.reprojection import linearize, reprojection_errors, retract, squared_error
from vitamin3d.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from vitamin3d.types import Array, Localization

ROUGH_GAIN = 1e-2
"""A pose that only has to tell inliers from outliers is refined until a step gains less than this share of the cost."""


@kernel
def _normal_equations(intrinsics, R, t, points, pixels, squared_sigma, H, g):  # type: ignore[no-untyped-def]
    r, J, J_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    H[:, :] = 0.0
    g[:] = 0.0
    for i in range(points.shape[0]):
        if not linearize(intrinsics, R, t, points[i], pixels[i], r, J, J_point):
            continue
        w = geman_mcclure_weight(r[0] * r[0] + r[1] * r[1], squared_sigma)
        for m in range(6):
            g[m] += w * (J[0, m] * r[0] + J[1, m] * r[1])
            for n in range(m, 6):
                H[m, n] += w * (J[0, m] * J[0, n] + J[1, m] * J[1, n])
    for m in range(6):
        for n in range(m):
            H[m, n] = H[n, m]


@kernel
def _cost(intrinsics, R, t, points, pixels, squared_sigma):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(points.shape[0]):
        e = squared_error(intrinsics, R, t, points[i], pixels[i])
        total += squared_sigma if e == np.inf else geman_mcclure_cost(e, squared_sigma)
    return total


@kernel
def _refine(intrinsics, R, t, points, pixels, squared_sigma, iterations, relative_gain):  # type: ignore[no-untyped-def]
    """Levenberg–Marquardt in place on R (3, 3), t (3,); the cost never rises. NaN input moves nothing."""
    H, g, R_new, t_new = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty(3)
    damping, cost = 1e-6, _cost(intrinsics, R, t, points, pixels, squared_sigma)
    if np.isnan(cost):
        return
    for _ in range(iterations):
        _normal_equations(intrinsics, R, t, points, pixels, squared_sigma, H, g)
        for m in range(6):
            H[m, m] += damping * H[m, m] + 1e-12
        delta = -np.linalg.solve(H, g)
        retract(delta, R, t, R_new, t_new)
        new_cost = _cost(intrinsics, R_new, t_new, points, pixels, squared_sigma)
        if new_cost <= cost:
            R[:, :], t[:] = R_new, t_new
            gain, cost, damping = cost - new_cost, new_cost, max(1e-9, 0.1 * damping)
            if gain <= relative_gain * cost:
                break
        else:
            damping = max(1e-4, 10.0 * damping)
            if damping > 1e6:
                break


def refine_pose(
    T_cam_world: Array, points_world: Array, pixels: Array, camera: Camera, sigma_px: float, iterations: int, relative_gain: float = 1e-6
) -> Array:
    """T_cam_world (4, 4) that minimises the Geman–McClure cost of the reprojection errors, from a first guess.

    It ends when a step gains less than relative_gain of the cost.
    """
    refined = np.array(T_cam_world)
    R, t = np.ascontiguousarray(refined[:3, :3]), np.ascontiguousarray(refined[:3, 3])
    _refine(
        camera.intrinsics, R, t, np.ascontiguousarray(points_world), np.ascontiguousarray(pixels), sigma_px**2, iterations, relative_gain
    )
    U, _, Vt = np.linalg.svd(R)
    refined[:3, :3], refined[:3, 3] = U @ Vt, t
    return refined


def _inliers(T: Array, points: Array, pixels: Array, camera: Camera, threshold_px: float) -> Array:
    return np.asarray(reprojection_errors(T, points, pixels, camera.intrinsics) < threshold_px)


def _best_start(T_prior: Array | None, points: Array, pixels: Array, camera: Camera, config: LocalizationConfig, seed: int) -> Array | None:
    """The prior (refined) if it explains enough, else the better one of it and of P3P RANSAC."""
    n, starts = len(points), []
    if T_prior is not None:
        starts.append(refine_pose(T_prior, points, pixels, camera, 2.0 * config.sigma_px, config.iterations, ROUGH_GAIN))
        if _inliers(starts[0], points, pixels, camera, config.outlier_px).mean() >= config.prior_inlier_ratio:
            return starts[0]
    sample = np.random.default_rng(seed).permutation(n)[: config.ransac_points]
    found = p3p_ransac(points[sample], pixels[sample], camera, config.ransac_threshold_px, config.ransac_iterations)
    starts += [] if found is None else [found]
    scores = [_inliers(T, points, pixels, camera, config.ransac_threshold_px).sum() for T in starts]
    return starts[int(np.argmax(scores))] if starts else None


def _outlier_limit(errors: Array, config: LocalizationConfig) -> float:
    """Pixels: a multiple of the median error, within the settings' bounds."""
    median = float(np.median(errors[errors < config.outlier_px])) if (errors < config.outlier_px).any() else config.outlier_px
    return min(config.outlier_px, max(config.min_outlier_px, config.outlier_medians * median))


def localize(
    points_world: Array, pixels: Array, T_prior: Array | None, camera: Camera, config: LocalizationConfig, seed: int = 0
) -> Localization:
    """Pose of a frame from landmarks (N, 3) and their ideal pixels (N, 2).

    Args:
        points_world, pixels: correspondences, some of them wrong.
        T_prior: T_cam_world (4, 4) of a motion model, or None.
        seed: of the random sample that RANSAC works on.

    Returns:
        Localization; `converged` is False with too few inliers, and the pose must not be used.
    """
    n = len(points_world)
    failed = Localization(np.eye(4) if T_prior is None else T_prior, np.zeros(n, np.bool_), float("nan"), False)
    if n < config.min_inliers:
        return failed
    start = _best_start(T_prior, points_world, pixels, camera, config, seed)
    if start is None:
        return failed
    T = refine_pose(start, points_world, pixels, camera, config.sigma_px, config.iterations)
    errors = reprojection_errors(T, points_world, pixels, camera.intrinsics)
    is_inlier = errors < _outlier_limit(errors, config)
    enough = is_inlier.sum() >= max(config.min_inliers, config.min_inlier_ratio * n)
    rmse = float(np.sqrt((errors[is_inlier] ** 2).mean())) if is_inlier.any() else float("nan")
    return Localization(T, is_inlier, rmse, bool(enough and np.isfinite(T).all()))
