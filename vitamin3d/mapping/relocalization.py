# SPDX-License-Identifier: Apache-2.0
"""The camera found again after its tracks broke (a drop-out, a jerk): descriptors against the newest keyframes.

The only place where descriptors meet the map. Corners of the frame are matched with those of a few keyframes; a
keyframe's corner that lies on a landmark's observation lends it that landmark, and P3P RANSAC does the rest.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from scipy.spatial import cKDTree

from vitamin3d.config import LocalizationConfig, RelocalizationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.mapping.p3p_localization import localize
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, Localization

FAST_THRESHOLD = 7


def described_corners(image: Array, count: int) -> tuple[Array, Array]:
    """Corners (N, 2) in distorted pixels of a picture (H, W) uint8, and their binary descriptors (N, 32) uint8."""
    orb = cv2.ORB_create(count, fastThreshold=FAST_THRESHOLD)  # type: ignore[attr-defined]
    keypoints, descriptors = orb.detectAndCompute(image, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
    return np.array([k.pt for k in keypoints], np.float64), descriptors


def landmark_matches(
    corners: tuple[Array, Array], keyframe: int, picture: Array, sparse_map: SparseMap, camera: Camera, config: RelocalizationConfig
) -> tuple[Array, Array]:
    """Landmarks (N,) ids of a keyframe and rows (N,) of the frame's corners that match them.

    Args:
        corners: of the frame, from `described_corners`.
        picture: (H, W) uint8 of the keyframe.
    """
    pixels, descriptors = described_corners(picture, config.corners)
    rows = sparse_map.observations_of(keyframe)
    ids = sparse_map.obs_landmark[rows]
    usable = sparse_map.obs_valid[rows] & sparse_map.is_mapped(ids)
    if len(pixels) == 0 or len(corners[0]) == 0 or not usable.any():
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    distances, nearest = cKDTree(sparse_map.obs_pixels[rows][usable]).query(np.nan_to_num(camera.undistort(pixels), nan=-1e6))
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, corners[1])
    pairs = np.array([(m.queryIdx, m.trainIdx) for m in matches], np.int64).reshape(-1, 2)
    pairs = pairs[distances[pairs[:, 0]] < config.max_distance_px]
    return ids[usable][nearest[pairs[:, 0]]], pairs[:, 1]


def relocalize(
    frame: Frame,
    keyframes: Iterable[tuple[int, Frame]],
    sparse_map: SparseMap,
    camera: Camera,
    config: RelocalizationConfig,
    localization: LocalizationConfig,
) -> Localization:
    """Pose of a frame from nothing but the map and the pictures of some keyframes; `converged` False where it is not found."""
    corners = described_corners(frame.image, config.corners)
    found = [landmark_matches(corners, k, picture.image, sparse_map, camera, config) for k, picture in keyframes]
    ids = np.concatenate([np.zeros(0, np.int64), *(pair[0] for pair in found)])
    pixels = camera.undistort(np.concatenate([np.zeros((0, 2)), *(corners[0][pair[1]] for pair in found)]))
    valid = np.isfinite(pixels[:, 0])
    return localize(sparse_map.points_world[ids[valid]], pixels[valid], None, camera, localization, frame.index)
