# SPDX-License-Identifier: Apache-2.0
"""Whether the map's newest motion is the one that its own tracks tell: a map may be bent, and stay so.

Where the camera hangs on few landmarks for a moment, new ones are placed by a false pose, and soon they are the majority: all agree, the
adjustment stays in this minimum, and the scale is another one. The tracks of two keyframes alone know rotation and direction of the way
between them; where these explain the tracks much better than the map does, the map is bent since its last sound keyframe.
"""

from dataclasses import dataclass, replace

import numpy as np

from vitamin3d.config import MotionCheckConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.epipolar_refinement import best_motion, motion_cost
from vitamin3d.geometry.se3 import inverse, rotation_angle_deg
from vitamin3d.sparse_map import SparseMap
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


def second_opinion(sparse_map: SparseMap, camera: Camera, config: MotionCheckConfig, newest: int = -1) -> Opinion | None:
    """A keyframe (-1: the last) against the oldest with which it shares enough landmarks; None where there is no such one."""
    newest %= sparse_map.num_keyframes
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
    landmarks = sparse_map.obs_landmark[rows]
    good = sparse_map.obs_valid[rows] & sparse_map.is_mapped(landmarks)
    return landmarks[good], sparse_map.obs_pixels[rows][good]


def _opinion(keyframe: int, T_1_0: Array, pixels_0: Array, pixels_1: Array, camera: Camera, config: MotionCheckConfig) -> Opinion | None:
    R, t = T_1_0[:3, :3], T_1_0[:3, 3]
    if not np.linalg.norm(t) > 0.0:
        return None
    some = slice(None, None, -(-len(pixels_0) // config.max_pairs))
    rays_0, rays_1 = camera.rays_from_ideal(pixels_0[some]), camera.rays_from_ideal(pixels_1[some])
    sigma = camera.radians(config.sigma_px)
    best = best_motion(R, t, rays_0, rays_1, sigma)
    ratio = motion_cost(R, t, rays_0, rays_1, sigma) / max(best.cost, 1e-12)
    direction = np.degrees(np.arccos(np.clip(abs(best.t @ t) / np.linalg.norm(t), 0.0, 1.0)))
    return Opinion(keyframe, float(ratio), rotation_angle_deg(best.R @ R.T), float(direction))


class MotionCheck:
    """Remembers up to which keyframe the map may be sound: a chain of keyframes each of which an older one of them confirms."""

    def __init__(self, config: MotionCheckConfig) -> None:
        self.config = config
        self._last_sound, self._last_linked, self._num_doubts = 0, 0, 0
        self._gap = 0, 0
        """The last two neighbours in the chain that nothing links."""

    def is_due(self, keyframe: int) -> bool:
        """Every few keyframes, and while there is a doubt at each one."""
        return self._num_doubts > 0 or keyframe % self.config.interval == 0

    def is_bent(self, sparse_map: SparseMap, camera: Camera) -> bool:
        """Whether the map has been bent since its last sound keyframe: its newest one says so, now and in the checks before, or is cut off.

        It is cut off where it agrees with keyframes that nothing links to those before: nothing has carried the scale there.
        """
        opinion = second_opinion(sparse_map, camera, self.config) if self.config.enabled else None
        if opinion is None:
            return False
        if self._is_sound(opinion):
            self._num_doubts = 0
            return self._is_cut_off(opinion, sparse_map, camera)
        if opinion.cost_ratio >= self.config.bent_ratio and self._is_other(opinion):
            self._num_doubts += 1
        return self._num_doubts > self.config.max_doubts

    def _is_cut_off(self, opinion: Opinion, sparse_map: SparseMap, camera: Camera) -> bool:
        """Adds the newest keyframe to the chain, unless it is cut off."""
        newest = sparse_map.num_keyframes - 1
        if opinion.keyframe > self._last_sound:
            self._extend(sparse_map, camera)
        if opinion.keyframe > self._last_linked:
            return True
        if opinion.keyframe > self._last_sound and self._last_sound < newest:
            self._gap = self._last_sound, newest
        self._last_sound = self._last_linked = newest
        return False

    def _extend(self, sparse_map: SparseMap, camera: Camera) -> None:
        """The chain up to the newest keyframe, by fewer pairs; loosely linked is what is not contradicted."""
        fewer = replace(self.config, min_pairs=self.config.min_pairs_of_a_link, min_share=0.0)
        for keyframe in range(max(2, self._last_sound + 1), sparse_map.num_keyframes):
            opinion = second_opinion(sparse_map, camera, fewer, keyframe)
            if opinion is None:
                continue
            if opinion.keyframe <= self._last_sound and self._is_sound(opinion):
                self._last_sound = keyframe
            if opinion.keyframe <= self._last_linked and opinion.cost_ratio <= self.config.linked_ratio:
                self._last_linked = max(self._last_linked, keyframe)
        self._last_linked = max(self._last_linked, self._last_sound)

    def last_sound(self, sparse_map: SparseMap, camera: Camera) -> int:
        """Where a map that was bent, or in which the camera was lost, had better end: before a loss it hangs on few landmarks too."""
        if not self.config.enabled:
            return sparse_map.num_keyframes - 1
        self._extend(sparse_map, camera)
        before, after = self._gap
        return before if sparse_map.num_keyframes - 1 - after < self.config.max_keyframes and after else self._last_sound

    def _is_other(self, opinion: Opinion) -> bool:
        """Whether the best motion is another one than the map's."""
        return opinion.turn_deg >= self.config.min_turn_deg or opinion.direction_deg >= self.config.min_direction_deg

    def _is_sound(self, opinion: Opinion) -> bool:
        return opinion.cost_ratio <= self.config.sound_ratio and not self._is_other(opinion)

    def move_to(self, kept_keyframes: Array) -> None:
        """Keyframes are numbered anew; `kept_keyframes` (K',) are the old numbers of those that stay."""
        old = self._last_sound, self._last_linked, *self._gap
        new = [max(0, int(np.searchsorted(kept_keyframes, keyframe, side="right")) - 1) for keyframe in old]
        self._last_sound, self._last_linked, self._gap, self._num_doubts = new[0], new[1], (new[2], new[3]), 0
