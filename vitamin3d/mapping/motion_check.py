# SPDX-License-Identifier: Apache-2.0
"""Whether the map's newest motion is the one that its own tracks tell: a map may be bent, and stay so.

Where the camera hangs on few landmarks for a moment, new ones are placed by a false pose, and soon they are the majority: all agree, the
adjustment stays in this minimum, and the scale is another one. The tracks of two keyframes alone know rotation and direction of the way
between them; where these explain the tracks much better than the map does, the map is bent since its last sound keyframe.
"""

from dataclasses import dataclass

import numpy as np

from vitamin3d.config import MotionCheckConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.epipolar_refinement import best_motion, motion_cost
from vitamin3d.geometry.se3 import inverse, rotation_angle_deg
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.types import Array


@dataclass(frozen=True)
class Opinion:
    """What two keyframes say by themselves."""

    keyframe: int
    """The older one."""
    cost_ratio: float
    """The cost of the map's motion over that of the best one, at least 1."""
    turn_deg: float
    """Between the two rotations."""
    direction_deg: float
    """Between the two ways."""


def second_opinion(sparse_map: SparseMap, camera: Camera, config: MotionCheckConfig) -> Opinion | None:
    """The newest keyframe against the oldest with which it shares enough landmarks; None where there is no such one."""
    newest = sparse_map.num_keyframes - 1
    ids_1, pixels_1 = _landmarks_of(sparse_map, newest)
    for keyframe in range(max(0, newest - config.max_keyframes), newest - 1):
        ids_0, pixels_0 = _landmarks_of(sparse_map, keyframe)
        _, in_0, in_1 = np.intersect1d(ids_0, ids_1, return_indices=True)
        if len(in_1) >= max(config.min_pairs, config.min_share * len(ids_1)):
            T_1_0 = sparse_map.T_cam_world[newest] @ inverse(sparse_map.T_cam_world[keyframe])
            return _opinion(keyframe, T_1_0, pixels_0[in_0], pixels_1[in_1], camera, config)
    return None


def _landmarks_of(sparse_map: SparseMap, keyframe: int) -> tuple[Array, Array]:
    """Ids (N,) and ideal pixels (N, 2) of the landmarks that a keyframe observes."""
    rows = sparse_map.observations_of(keyframe)
    ids = sparse_map.obs_landmark[rows]
    good = sparse_map.obs_valid[rows] & sparse_map.is_mapped(ids)
    return ids[good], sparse_map.obs_pixels[rows][good]


def _opinion(keyframe: int, T_1_0: Array, pixels_0: Array, pixels_1: Array, camera: Camera, config: MotionCheckConfig) -> Opinion | None:
    R, t = T_1_0[:3, :3], T_1_0[:3, 3]
    if not np.linalg.norm(t) > 0.0:
        return None
    some = slice(None, None, -(-len(pixels_0) // config.max_pairs))
    rays_0, rays_1 = camera.rays_from_ideal(pixels_0[some]), camera.rays_from_ideal(pixels_1[some])
    sigma = config.sigma_px / camera.fx
    best = best_motion(R, t, rays_0, rays_1, sigma)
    ratio = motion_cost(R, t, rays_0, rays_1, sigma) / max(best.cost, 1e-12)
    direction = np.degrees(np.arccos(np.clip(abs(best.t @ t) / np.linalg.norm(t), 0.0, 1.0)))
    return Opinion(keyframe, float(ratio), rotation_angle_deg(best.R @ R.T), float(direction))


class MotionCheck:
    """Remembers up to which keyframe the map may be sound."""

    def __init__(self, config: MotionCheckConfig) -> None:
        self.config = config
        self.last_sound, self._num_doubts = 0, 0
        """The last keyframe that the newest one did not doubt."""

    def is_bent(self, sparse_map: SparseMap, camera: Camera) -> bool:
        """Whether the map has been bent since its keyframe `last_sound`, by its newest one, now and in the checks before."""
        opinion = second_opinion(sparse_map, camera, self.config) if self.config.enabled else None
        if opinion is None:
            return False
        is_other = opinion.turn_deg >= self.config.min_turn_deg or opinion.direction_deg >= self.config.min_direction_deg
        if opinion.cost_ratio <= self.config.sound_ratio and not is_other:
            self.last_sound, self._num_doubts = sparse_map.num_keyframes - 1, 0
        elif opinion.cost_ratio >= self.config.bent_ratio and is_other:
            if self._num_doubts == 0:
                self.last_sound = max(self.last_sound, opinion.keyframe)
            self._num_doubts += 1
        return self._num_doubts > self.config.max_doubts

    def move_to(self, kept_keyframes: Array) -> None:
        """Keyframes are numbered anew; `kept_keyframes` (K',) are the old numbers of those that stay."""
        self.last_sound, self._num_doubts = max(0, int(np.searchsorted(kept_keyframes, self.last_sound, side="right")) - 1), 0
