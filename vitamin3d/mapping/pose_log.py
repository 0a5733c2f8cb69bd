# SPDX-License-Identifier: Apache-2.0
"""The poses of all localised frames, each kept relative to a keyframe, so that later adjustments move it along."""

import numpy as np

from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, Trajectory


class PoseLog:
    """Frames in the order in which they were localised; the last two make the motion model."""

    def __init__(self) -> None:
        self._entries: dict[int, tuple[int, int, Array]] = {}
        self._last: list[int] = []

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, frame: Frame, keyframe: int, T_cam_keyframe: Array) -> None:
        """Logs a frame by its pose relative to a keyframe (the identity for the keyframe itself)."""
        self._entries[frame.index] = (frame.timestamp_ns, keyframe, T_cam_keyframe)
        self._last = [*self._last[-1:], frame.index]

    def add_world(self, frame: Frame, T_cam_world: Array, sparse_map: SparseMap) -> None:
        """Logs a frame by its pose (4, 4), relative to the newest keyframe that is not younger."""
        keyframe = max(0, int(np.searchsorted(sparse_map.frame_indices, frame.index, side="right")) - 1)
        self.add(frame, keyframe, T_cam_world @ inverse(sparse_map.T_cam_world[keyframe]))

    def pose(self, frame_index: int, sparse_map: SparseMap) -> Array:
        """T_cam_world (4, 4) of a logged frame as the map stands now."""
        _, keyframe, T_cam_keyframe = self._entries[frame_index]
        return np.asarray(T_cam_keyframe @ sparse_map.T_cam_world[keyframe])

    def predict(self, sparse_map: SparseMap) -> Array:
        """T_cam_world (4, 4) of the next frame, moving on as between the last two."""
        newest = self.pose(self._last[-1], sparse_map)
        if len(self._last) < 2 or self._last[1] - self._last[0] != 1:
            return newest
        return np.asarray(newest @ inverse(self.pose(self._last[0], sparse_map)) @ newest)

    def trajectory(self, sparse_map: SparseMap) -> Trajectory:
        """Camera-to-world poses of all logged frames, by time."""
        indices = sorted(self._entries)
        stamps = np.array([self._entries[i][0] for i in indices], np.int64)
        poses = [inverse(self.pose(i, sparse_map)) for i in indices]
        return Trajectory(stamps, np.array(poses).reshape(-1, 4, 4))
