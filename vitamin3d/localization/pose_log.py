# SPDX-License-Identifier: Apache-2.0
"""The poses of all localised frames, each kept relative to a keyframe, so that later adjustments move it along."""

from collections.abc import Iterable

import numpy as np

from vitamin3d.geometry.se3 import inverse
from vitamin3d.growing_array import GrowingArray
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, Trajectory


class PoseLog:
    """Frames in the order in which they were localised; the last two make the motion model."""

    def __init__(self) -> None:
        self._row_of_frame: dict[int, int] = {}
        self._frames, self._stamps, self._keyframes = (GrowingArray((), np.int64, -1) for _ in range(3))
        self._T_cam_keyframe = GrowingArray((4, 4), np.float64, 0.0)
        self._last: list[int] = []

    def __len__(self) -> int:
        return len(self._row_of_frame)

    def add(self, frame: Frame, keyframe: int, T_cam_keyframe: Array) -> None:
        """Logs a frame by its pose relative to a keyframe (the identity for the keyframe itself)."""
        row = self._row_of_frame.setdefault(frame.index, self._frames.size)
        values = ((self._frames, frame.index), (self._stamps, frame.timestamp_ns), (self._keyframes, keyframe))
        for array, value in (*values, (self._T_cam_keyframe, T_cam_keyframe)):
            array.resize(row + 1)
            array.view[row] = value
        self._last = [*self._last[-1:], frame.index]

    def add_world(self, frame: Frame, T_cam_world: Array, sparse_map: SparseMap) -> None:
        """Logs a frame by its pose (4, 4), relative to the newest keyframe that is not younger."""
        keyframe = max(0, int(np.searchsorted(sparse_map.frame_indices, frame.index, side="right")) - 1)
        self.add(frame, keyframe, T_cam_world @ inverse(sparse_map.T_cam_world[keyframe]))

    def __contains__(self, frame_index: object) -> bool:
        return frame_index in self._row_of_frame

    def num_beyond(self, other: "PoseLog") -> int:
        """How many frames the other log does not have."""
        return len(self._row_of_frame.keys() - other._row_of_frame.keys())

    @property
    def first_frame(self) -> int:
        """Index of the earliest frame."""
        return min(self._row_of_frame)

    def forget(self, frame_indices: Iterable[int]) -> None:
        """Takes frames out of the log."""
        for index in frame_indices:
            self._frames.view[self._row_of_frame.pop(index)] = -1
        self._last = [index for index in self._last if index in self._row_of_frame] or sorted(self._row_of_frame)[-1:]

    def forget_since(self, frame_index: int) -> None:
        """Takes a frame and those after it out of the log."""
        self.forget([index for index in self._row_of_frame if index >= frame_index])

    def pose(self, frame_index: int, sparse_map: SparseMap) -> Array:
        """T_cam_world (4, 4) of a logged frame as the map stands now."""
        row = self._row_of_frame[frame_index]
        return np.asarray(self._T_cam_keyframe.view[row] @ sparse_map.T_cam_world[self._keyframes.view[row]])

    def shift(self, frame_index: int, offset_world: Array, sparse_map: SparseMap) -> None:
        """Moves the camera of a logged frame by an offset (3,) in the world."""
        row, R_cam_world = self._row_of_frame[frame_index], self.pose(frame_index, sparse_map)[:3, :3]
        self._T_cam_keyframe.view[row, :3, 3] -= R_cam_world @ offset_world

    def newest(self, sparse_map: SparseMap) -> Array:
        """T_cam_world (4, 4) of the frame logged last."""
        return self.pose(self._last[-1], sparse_map)

    @property
    def newest_timestamp_ns(self) -> int:
        """Of the frame logged last."""
        return int(self._stamps.view[self._row_of_frame[self._last[-1]]])

    def predict(self, sparse_map: SparseMap) -> Array:
        """T_cam_world (4, 4) of the next frame, moving on as between the last two."""
        newest = self.newest(sparse_map)
        if len(self._last) < 2 or self._last[1] - self._last[0] != 1:
            return newest
        return np.asarray(newest @ inverse(self.pose(self._last[0], sparse_map)) @ newest)

    def move_to(self, kept_keyframes: Array, sparse_map: SparseMap) -> None:
        """Keyframes are numbered anew, in their order; what hung on one that leaves hangs on the one before it.

        Args:
            kept_keyframes: (K',) old numbers, the first among them.
            sparse_map: with the old numbers.
        """
        old = self._keyframes.view
        new = np.searchsorted(kept_keyframes, old, side="right") - 1
        heirs = kept_keyframes[new]
        moved = np.flatnonzero(heirs != old)
        poses = sparse_map.T_cam_world
        self._T_cam_keyframe.view[moved] = self._T_cam_keyframe.view[moved] @ poses[old[moved]] @ inverse(poses[heirs[moved]])
        self._keyframes.view[:] = new

    def trajectory(self, sparse_map: SparseMap) -> Trajectory:
        """Camera-to-world poses of all logged frames, by time."""
        order = np.argsort(self._frames.view)[(self._frames.view < 0).sum() :]
        poses = self._T_cam_keyframe.view[order] @ sparse_map.T_cam_world[self._keyframes.view[order]]
        return Trajectory(self._stamps.view[order], inverse(poses))
