# SPDX-License-Identifier: Apache-2.0
"""Relative pose of two views by the essential matrix: OpenCV's USAC, then the best motion for all pairs."""

import cv2
import numpy as np

from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.epipolar_refinement import refine_essential, sampson_distances
from vitamin3d.geometry.triangulation import triangulate
from vitamin3d.types import Array, TwoView

MAX_POINT_ERROR_PX = 3.0


def relative_pose(pixels_0: Array, pixels_1: Array, camera: Camera, threshold_px: float) -> TwoView | None:
    """The motion between two views up to the length of its translation, with the points they see.

    Args:
        pixels_0, pixels_1: (N, 2) paired ideal pixels, N >= 8.
        camera: of both views.
        threshold_px: inlier threshold, Sampson distance.

    Returns:
        TwoView, |translation| = 1, of the decomposition with most points in front of both cameras; None where no
        essential matrix was found.
    """
    E, mask = cv2.findEssentialMat(pixels_0, pixels_1, camera.K, cv2.USAC_ACCURATE, 0.999, threshold_px)
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    first = _in_front(E, mask.ravel() > 0, pixels_0, pixels_1, camera)
    rays_0, rays_1 = camera.rays_from_ideal(pixels_0), camera.rays_from_ideal(pixels_1)
    threshold = camera.radians(threshold_px)
    E = refine_essential(first.T_1_0[:3, :3], first.T_1_0[:3, 3], rays_0, rays_1, threshold)
    return _in_front(E, np.abs(sampson_distances(E, rays_0, rays_1)) < threshold, pixels_0, pixels_1, camera)


def _in_front(E: Array, is_inlier: Array, pixels_0: Array, pixels_1: Array, camera: Camera) -> TwoView:
    """Of the four motions of an essential matrix the one with most points in front of both cameras."""
    R_a, R_b, t = cv2.decomposeEssentialMat(E)
    candidates = [_two_view(R, s * t, is_inlier, pixels_0, pixels_1, camera) for R in (R_a, R_b) for s in (1.0, -1.0)]
    return max(candidates, key=lambda view: int(np.isfinite(view.points_0[:, 0]).sum()))


def _two_view(R: Array, t: Array, is_inlier: Array, pixels_0: Array, pixels_1: Array, camera: Camera) -> TwoView:
    T_1_0 = np.eye(4)
    T_1_0[:3, :3], T_1_0[:3, 3] = R, t.ravel()
    points, parallax = triangulate(camera.rays_from_ideal(pixels_0), camera.rays_from_ideal(pixels_1), T_1_0)
    points_1 = points @ R.T + t.ravel()
    error_0 = np.linalg.norm(camera.ideal_from_points(points) - pixels_0, axis=1)
    error_1 = np.linalg.norm(camera.ideal_from_points(points_1) - pixels_1, axis=1)
    with np.errstate(invalid="ignore"):
        good = is_inlier & (points[:, 2] > 0) & (points_1[:, 2] > 0) & (np.maximum(error_0, error_1) < MAX_POINT_ERROR_PX)
    points[~good] = np.nan
    return TwoView(T_1_0, points, parallax, is_inlier)
