# SPDX-License-Identifier: Apache-2.0
"""The camera found again after its tracks broke (a drop-out, a jerk): descriptors against the newest keyframes.

The only place where descriptors meet the map. Corners of the frame are matched with those of a few keyframes; a
keyframe's corner that lies on a landmark's observation lends it that landmark, and P3P RANSAC does the rest.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vitamin3d.config import LocalizationConfig, RelocalizationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.image.corners import described_corners, mutual_matches
from vitamin3d.localization.p3p_localization import localize
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, Localization


class RememberedKeyframes:
    """Pictures of keyframes in which the camera may be found again: the newest, and every so many-th of those before; described once."""

    def __init__(self, config: RelocalizationConfig) -> None:
        self.config = config
        self._pictures: dict[int, Frame] = {}
        self._corners: dict[int, tuple[Array, Array]] = {}

    def add(self, keyframe: int, frame: Frame) -> None:
        """Remembers a new keyframe; of the older ones every `stride`-th stays, the oldest leave."""
        self._pictures[keyframe] = replace(frame, color=None)
        passing = keyframe - self.config.keyframes
        if passing % self.config.stride:
            self._forget(passing)
        if len(self._pictures) > self.config.max_remembered:
            self._forget(min(self._pictures))

    def _forget(self, keyframe: int) -> None:
        self._pictures.pop(keyframe, None)
        self._corners.pop(keyframe, None)

    def move_to(self, kept_keyframes: Array) -> None:
        """Keyframes are numbered anew; `kept_keyframes` (K',) are the old numbers of those that stay."""
        new = {int(old): k for k, old in enumerate(kept_keyframes)}
        self._pictures = {new[k]: picture for k, picture in self._pictures.items() if k in new}
        self._corners = {new[k]: corners for k, corners in self._corners.items() if k in new}

    def to_try(self, num_lost: int) -> list[tuple[int, tuple[Array, Array]]]:
        """Keyframes and their described corners: the newest first, others in turn the longer the camera is lost."""
        newest_first, count = sorted(self._pictures, reverse=True), self.config.keyframes
        chosen = newest_first[:count]
        if num_lost >= self.config.tries_at_once:
            others = newest_first[count:] or chosen
            begin = (num_lost // self.config.interval * (count - 1)) % max(1, len(others))
            chosen = newest_first[:1] + (others + others)[begin : begin + count - 1]
        return [(k, self._described(k)) for k in dict.fromkeys(chosen)]

    def _described(self, keyframe: int) -> tuple[Array, Array]:
        if keyframe not in self._corners:
            self._corners[keyframe] = described_corners(self._pictures[keyframe].image, self.config.corners)
        return self._corners[keyframe]


def landmark_matches(
    corners: tuple[Array, Array], keyframe: int, described: tuple[Array, Array], sparse_map: SparseMap, camera: Camera,
    config: RelocalizationConfig,
) -> tuple[Array, Array]:  # fmt: skip
    """Landmarks (N,), their rows in the map, of a keyframe and rows (N,) of the frame's corners that match them.

    Args:
        corners: of the frame, from `described_corners`.
        described: the same of the keyframe.
    """
    none = np.zeros(0, np.int64), np.zeros(0, np.int64)
    pixels, descriptors = described
    rows = sparse_map.observations_of(keyframe)
    landmarks = sparse_map.obs_landmark[rows]
    usable = sparse_map.obs_valid[rows] & sparse_map.is_mapped(landmarks)
    if len(pixels) == 0 or len(corners[0]) == 0 or not usable.any():
        return none
    distances, nearest = cKDTree(sparse_map.obs_pixels[rows][usable]).query(np.nan_to_num(camera.undistort(pixels), nan=-1e6))
    lent = np.flatnonzero(distances < config.max_distance_px)
    if len(lent) == 0:
        return none
    pairs = mutual_matches(descriptors[lent], corners[1])
    return landmarks[usable][nearest[lent[pairs[:, 0]]]], pairs[:, 1]


def relocalize(
    frame: Frame,
    keyframes: Iterable[tuple[int, tuple[Array, Array]]],
    sparse_map: SparseMap,
    camera: Camera,
    config: RelocalizationConfig,
    localization: LocalizationConfig,
) -> Localization:
    """Pose of a frame from nothing but the map and the described corners of some keyframes; `converged` False where it is not found."""
    corners = described_corners(frame.image, config.corners)
    found = [landmark_matches(corners, k, described, sparse_map, camera, config) for k, described in keyframes]
    pairs = np.concatenate([np.zeros((0, 2), np.int64), *(np.column_stack(pair) for pair in found)])
    landmarks, rows = np.unique(pairs, axis=0).T  # what several keyframes say counts once
    pixels = camera.undistort(corners[0][rows])
    valid = np.isfinite(pixels[:, 0])
    return localize(sparse_map.points_world[landmarks[valid]], pixels[valid], None, camera, localization, frame.index)


def is_search_due(num_lost: int, config: RelocalizationConfig) -> bool:
    """Whether the search is worth its time in the so many-th frame in a row that is lost (from 0): at once, then now and then."""
    return num_lost < config.tries_at_once or num_lost % config.interval == 0
