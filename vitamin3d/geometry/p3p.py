# SPDX-License-Identifier: Apache-2.0
"""Pose from three points in RANSAC (OpenCV's AP3P), behind our conventions."""

import cv2
import numpy as np

from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array


def p3p_ransac(points_world: Array, pixels: Array, camera: Camera, threshold_px: float, iterations: int) -> Array | None:
    """T_cam_world (4, 4) from points (N, 3) and their ideal pixels (N, 2), N >= 4; None where no pose was found."""
    if len(points_world) < 4:
        return None
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(points_world),
        np.ascontiguousarray(pixels),
        camera.K,
        None,
        iterationsCount=iterations,
        reprojectionError=threshold_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or not np.isfinite(tvec).all():
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rvec)[0]
    T[:3, 3] = tvec.ravel()
    return T
