# SPDX-License-Identifier: Apache-2.0
"""The keyframes on their way to the dense half: kept until nothing moves them any more, then handed over once, with their landmarks."""

import numpy as np

from vitamin3d.config import Config, WindowConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rolling_shutter import at_one_moment
from vitamin3d.mapping.landmark_statistics import UnitInformation, keyframe_vertices
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, MapSnapshot

UNTAKEN_WINDOWS, UNTAKEN_KEYFRAMES = 2, 16
"""Pictures of keyframes that nobody takes are kept for so many windows, or keyframes where that is more."""


class KeyframeHandover:
    """Pictures of the keyframes that nobody has taken yet."""

    def __init__(self, window: WindowConfig) -> None:
        self.window = window
        self.num_kept = max(UNTAKEN_KEYFRAMES, UNTAKEN_WINDOWS * window.keyframes)
        """So many of the newest keyframes wait at most, those of a new map apart."""
        self._frames: dict[int, Frame] = {}

    def begin(self, frames: list[Frame]) -> None:
        """The keyframes of a new map."""
        self._frames = dict(enumerate(frames))

    def add(self, keyframe: int, frame: Frame) -> None:
        """A new keyframe; the oldest is given up where nobody takes any."""
        self._frames[keyframe] = frame
        self._frames.pop(keyframe - self.num_kept, None)

    def take_settled(self, num_keyframes: int, newest_frame: int, everything: bool = False) -> list[tuple[int, Frame]]:
        """The keyframes that settled since the last call (or all that remain), each once, with their frames."""
        window = self.window
        settled = num_keyframes if everything else num_keyframes - (window.settled_keyframes or window.keyframes)
        rests_since = newest_frame - window.settled_frames if window.settled_frames else -1
        ready = sorted(k for k, frame in self._frames.items() if k < settled or frame.index <= rests_since)
        return [(k, self._frames.pop(k)) for k in ready]

    def forget(self, kept_keyframes: Array, num_keyframes: int) -> None:
        """Of so many keyframes only those with the numbers (K',) stay, and are numbered anew."""
        is_kept = np.isin(np.arange(num_keyframes), kept_keyframes)
        self._frames = {int(np.searchsorted(kept_keyframes, k)): f for k, f in self._frames.items() if is_kept[k]}


def snapshot_of(
    sparse_map: SparseMap, keyframe: int, frame: Frame, camera: Camera, config: Config, map_number: int, by_row: UnitInformation | None
) -> MapSnapshot:
    """A keyframe with the depths of its landmarks as the map has them now; its picture as if read at one moment.

    Args:
        by_row: the map's `information_by_row`, for many keyframes of a map that is finished.
    """
    vertices = keyframe_vertices(sparse_map, keyframe, camera, config.snapshot, by_row)
    motion = sparse_map.image_motions[keyframe]
    return MapSnapshot(at_one_moment(frame, motion, camera), sparse_map.clone_pose(keyframe), *vertices, map_number)
