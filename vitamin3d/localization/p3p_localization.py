# SPDX-License-Identifier: Apache-2.0
"""Localisation of a frame against the map: P3P RANSAC, then a robust refinement of the pose (Sec. 5.1)."""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import WIDTH, gather, splat, total
from vitamin3d.bundle_adjustment.normal_equations import add_camera, no_camera, write_camera
from vitamin3d.bundle_adjustment.observations import information, robust_cost, rows_from
from vitamin3d.bundle_adjustment.subspace import new_scratch
from vitamin3d.bundle_adjustment.variables import pinhole_model
from vitamin3d.config import LocalizationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.cholesky import solve_6x6
from vitamin3d.geometry.p3p import p3p_ransac
from vitamin3d.geometry.reprojection import (
    in_camera,
    linearize_simd,
    model_of,
    points_of,
    pose_of,
    reprojection_errors,
    retract,
    squared_error_simd,
)
from vitamin3d.types import Array, Localization

ROUGH_GAIN = 1e-2
"""A pose that only has to tell inliers from outliers is refined until a step gains less than this share of the cost."""


@inlined
def _rows(points, pixels, pose, i):  # type: ignore[no-untyped-def]
    """Eight correspondences from the i-th: which of them are there, the points in the camera frame, the pixels."""
    rows, is_there = rows_from(i, points.shape[0])
    X, Y, Z = points_of(points, rows)
    x, y, z = in_camera(pose, X, Y, Z)
    return is_there, x, y, z, gather(pixels, 2 * rows), gather(pixels, 2 * rows + 1)


@kernel
def _cost(models, R, t, points, pixels, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    model, pose, cost = model_of(models, 0), pose_of(R, t, 0), splat(0.0)
    for i in range(0, points.shape[0], WIDTH):
        is_there, x, y, z, u, v = _rows(points, pixels, pose, i)
        cost = cost + robust_cost(is_there, squared_error_simd(x, y, z, False, model, u, v), inverse_squared_sigma)
    return total(cost)


@kernel
def _normal_equations(models, R, t, points, pixels, inverse_squared_sigma, sums, H, g):  # type: ignore[no-untyped-def]
    """Fills H (6, 6), upper triangle, and g (6,); `sums` (27,) is memory."""
    model, pose, block = model_of(models, 0), pose_of(R, t, 0), no_camera()
    for i in range(0, points.shape[0], WIDTH):
        is_there, x, y, z, u, v = _rows(points, pixels, pose, i)
        is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = linearize_simd(x, y, z, False, model, u, v)
        _, _, g00, g01, g11, h0, h1, _, _, _ = information(is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
        block = add_camera(block, q, a, b, g00, g01, g11, h0, h1)
    write_camera(block, sums, H, g)


@kernel
def _refine(models, R, t, points, pixels, inverse_squared_sigma, iterations, relative_gain, scratch):  # type: ignore[no-untyped-def]
    """Levenberg–Marquardt in place on R (1, 3, 3), t (1, 3); the cost never rises. With a NaN pose or pixel nothing moves."""
    sums, H, g, delta, R_new, t_new = scratch
    damping, cost = 1e-6, _cost(models, R, t, points, pixels, inverse_squared_sigma)
    for _ in range(iterations):
        _normal_equations(models, R, t, points, pixels, inverse_squared_sigma, sums, H[0], g)
        for m in range(6):
            H[0, m, m] += damping * H[0, m, m] + 1e-12
        new_cost = np.inf
        if solve_6x6(H, g, delta):
            retract(delta, R[0], t[0], R_new[0], t_new[0])
            new_cost = _cost(models, R_new, t_new, points, pixels, inverse_squared_sigma)
        if new_cost <= cost:
            R[:], t[:] = R_new, t_new
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
    R, t = np.ascontiguousarray(refined[None, :3, :3]), np.ascontiguousarray(refined[None, :3, 3])
    _refine(
        pinhole_model(camera), R, t, np.ascontiguousarray(points_world), np.ascontiguousarray(pixels), 1.0 / sigma_px**2, iterations,
        relative_gain, new_scratch(),
    )  # fmt: skip
    U, _, Vt = np.linalg.svd(R[0])
    refined[:3, :3], refined[:3, 3] = U @ Vt, t[0]
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


def voters(num_observations: Array, config: LocalizationConfig) -> Array:
    """(N,) bool: which landmarks, by their observations in keyframes (N,), localise the camera; where few have many, the next too."""
    votes = config.votes
    while votes > 2 and (num_observations >= votes).sum() < config.min_voters:
        votes //= 2
    return np.asarray(num_observations >= votes)


def localize_by(
    is_voter: Array, points_world: Array, pixels: Array, T_prior: Array | None, camera: Camera, config: LocalizationConfig, seed: int = 0
) -> Localization:
    """As `localize`, the pose being that of the voters (N,) bool alone; the other landmarks are judged by it."""
    if is_voter.all():
        return localize(points_world, pixels, T_prior, camera, config, seed)
    found = localize(points_world[is_voter], pixels[is_voter], T_prior, camera, config, seed)
    if not found.converged:
        return Localization(found.T_cam_world, np.zeros(len(is_voter), np.bool_), found.rmse_px, False)
    is_inlier = np.zeros(len(is_voter), np.bool_)
    is_inlier[is_voter] = found.is_inlier
    errors = reprojection_errors(found.T_cam_world, points_world[~is_voter], pixels[~is_voter], camera.intrinsics)
    limit = min(config.outlier_px, max(config.min_outlier_px, config.outlier_medians * found.rmse_px))
    is_inlier[~is_voter] = errors < limit
    return Localization(found.T_cam_world, is_inlier, found.rmse_px, True)
