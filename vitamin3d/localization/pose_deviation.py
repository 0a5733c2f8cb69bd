# SPDX-License-Identifier: Apache-2.0
"""How well the landmarks of a frame determine where its camera is."""

import numpy as np

from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array

LEAST_SIGMA_PX = 0.5
"""Errors of a picture have so much in common that no pose is known better than by such ones."""
MIN_LANDMARKS = 6
UNKNOWN_DEG = 90.0


def position_deviation_deg(points_cam: Array, errors_px: Array, camera: Camera) -> float:
    """Standard deviation of the camera's position in its least certain direction, as the angle that it makes up at the median depth.

    The inverse of the Gauss–Newton matrix of the reprojection errors; a parallax much larger than this angle is one of the scene, a
    smaller one may be that of the pose's error.

    Args:
        points_cam: (N, 3) landmarks in the camera frame, those that the pose comes from.
        errors_px: (N,) their reprojection errors.
    """
    depth = points_cam[:, 2]
    if len(depth) < MIN_LANDMARKS:
        return UNKNOWN_DEG
    J_u, J_v = camera.pose_jacobians(points_cam)
    variance = max(LEAST_SIGMA_PX**2, 0.5 * float((errors_px**2).mean()))
    H = J_u.T @ J_u + J_v.T @ J_v
    if np.linalg.matrix_rank(H, hermitian=True) < len(H):
        return UNKNOWN_DEG
    covariance = variance * np.linalg.inv(H)
    deviation = np.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))) / float(np.median(depth))
    return min(UNKNOWN_DEG, float(np.degrees(deviation)))
