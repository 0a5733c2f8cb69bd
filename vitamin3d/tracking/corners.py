# SPDX-License-Identifier: Apache-2.0
"""Corners with binary descriptors, and which of two pictures' are the same: where neither flow nor map tells what went where."""

import cv2
import numpy as np

from vitamin3d.types import Array

FAST_THRESHOLD = 7


def described_corners(image: Array, count: int) -> tuple[Array, Array]:
    """Corners (N, 2) in distorted pixels of a picture (H, W) uint8, and their binary descriptors (N, 32) uint8."""
    orb = cv2.ORB_create(count, fastThreshold=FAST_THRESHOLD)  # type: ignore[attr-defined]
    keypoints, descriptors = orb.detectAndCompute(image, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
    return np.array([k.pt for k in keypoints], np.float64), descriptors


def mutual_matches(a: Array, b: Array) -> Array:
    """Rows (M, 2) of descriptors a (N, 32) and b (K, 32) uint8 that are each other's nearest."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a, b)
    return np.array([(m.queryIdx, m.trainIdx) for m in matches], np.int64).reshape(-1, 2)
