# SPDX-License-Identifier: Apache-2.0
"""Pictures that repeat the one before, bit by bit: the next other one tells where the camera was meanwhile."""

from dataclasses import replace

from vitamin3d.geometry.se3 import between
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Frame


class RepeatedPictures:
    """The frames of them that wait for their poses."""

    def __init__(self) -> None:
        self._waiting: list[Frame] = []

    def add(self, frame: Frame) -> None:
        """A picture that says nothing about where the camera is by now."""
        self._waiting.append(replace(frame, image=frame.image[:0].copy(), color=None))

    def place(self, timestamp_ns: int, T_cam_world: Array | None, poses: PoseLog, sparse_map: SparseMap) -> None:
        """Logs them on the way between the camera's places before them and now; nowhere where it is not known now."""
        repeats, self._waiting = self._waiting, []
        if T_cam_world is None or not repeats:
            return
        before, since_ns = poses.newest(sparse_map), poses.newest_timestamp_ns
        for frame in repeats:
            share = (frame.timestamp_ns - since_ns) / max(1, timestamp_ns - since_ns)
            poses.add_world(frame, between(before, T_cam_world, share), sparse_map)

    def finish(self, poses: PoseLog, sparse_map: SparseMap) -> None:
        """The recording is over: the camera rests, for all that is known."""
        if self._waiting:
            self.place(self._waiting[-1].timestamp_ns, poses.newest(sparse_map), poses, sparse_map)
