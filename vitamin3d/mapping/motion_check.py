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
from vitamin3d.geometry.se3 import inverse
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
    for keyframe in range(max(0, newest - config.max_keyframes), newest - 1):
        pixels_0, pixels_1, share = _shared_landmarks(sparse_map, keyframe, newest)
        if len(pixels_0) >= config.min_pairs and share >= config.min_share:
            T_1_0 = sparse_map.T_cam_world[newest] @ inverse(sparse_map.T_cam_world[keyframe])
            return _opinion(keyframe, T_1_0, pixels_0, pixels_1, camera, config)
    return None


def _shared_landmarks(sparse_map: SparseMap, keyframe_0: int, keyframe_1: int) -> tuple[Array, Array, float]:
    """Ideal pixels (N, 2) in both keyframes of the landmarks that both observe, and their share of those of the second."""
    rows = [sparse_map.observations_of(k) for k in (keyframe_0, keyframe_1)]
    ids = [sparse_map.obs_landmark[r] for r in rows]
    good = [np.flatnonzero(sparse_map.obs_valid[r] & sparse_map.is_mapped(i)) for r, i in zip(rows, ids, strict=True)]
    _, in_0, in_1 = np.intersect1d(ids[0][good[0]], ids[1][good[1]], return_indices=True)
    pixels = [sparse_map.obs_pixels[r][g[i]] for r, g, i in zip(rows, good, (in_0, in_1), strict=True)]
    return pixels[0], pixels[1], len(in_1) / max(1, len(good[1]))


def _opinion(keyframe: int, T_1_0: Array, pixels_0: Array, pixels_1: Array, camera: Camera, config: MotionCheckConfig) -> Opinion | None:
    R, t = T_1_0[:3, :3], T_1_0[:3, 3]
    if not np.linalg.norm(t) > 0.0:
        return None
    some = slice(None, None, -(-len(pixels_0) // config.max_pairs))
    rays_0, rays_1 = camera.rays_from_ideal(pixels_0[some]), camera.rays_from_ideal(pixels_1[some])
    sigma = config.sigma_px / camera.fx
    best = best_motion(R, t, rays_0, rays_1, sigma)
    ratio = motion_cost(R, t, rays_0, rays_1, sigma) / max(best.cost, 1e-12)
    turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(best.R @ R.T) - 1.0), -1.0, 1.0)))
    direction = np.degrees(np.arccos(np.clip(abs(best.t @ t) / np.linalg.norm(t), 0.0, 1.0)))
    return Opinion(keyframe, float(ratio), float(turn), float(direction))


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
