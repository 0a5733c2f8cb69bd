# SPDX-License-Identifier: Apache-2.0
"""The maps of a run: what begins, keeps and ends them.

Where the camera is lost, a new map begins beside the search for the old one. Whichever comes first goes on: the old map with the
camera found in it, or the new one once it has held for a while. A map that is lost while it is young is dropped and made anew.
"""

from vitamin3d.config import Config
from vitamin3d.geometry.camera import Camera
from vitamin3d.slam import Slam
from vitamin3d.types import FrontEndFrame, SlamState


class Atlas:
    """Never gives up: tracks a sequence through as many maps as it takes."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.camera, self.config = camera, config
        self.maps: list[Slam] = []
        """Those that were left, each lost."""
        self.active = Slam(camera, config)
        """The map in which the camera is tracked, or was last."""
        self.successor: Slam | None = None
        """The next one, while the camera is lost in the active one."""

    def process_frame(self, front: FrontEndFrame) -> SlamState:
        """One frame: tracked in the active map, or in the one that begins where that is lost."""
        state = self.active.process_frame(front)
        if state is not SlamState.LOST:
            self._drop_successor()
            return state
        if self._is_young(self.active) and self.successor is None:
            self.active = self._new_map()
            return self.active.process_frame(front)
        return self._succeed(front)

    def _succeed(self, front: FrontEndFrame) -> SlamState:
        """The frame in the successor, which becomes the active map when it has held for a while."""
        self.successor = self.successor or self._new_map()
        state = self.successor.process_frame(front)
        if state is SlamState.LOST:
            self.successor = None
        elif state is SlamState.TRACKING and not self._is_young(self.successor):
            self.maps.append(self.active)
            self.active, self.successor = self.successor, None
        return state

    def _drop_successor(self) -> None:
        self.successor = None

    def _new_map(self) -> Slam:
        return Slam(self.camera, self.config)

    def _is_young(self, slam: Slam) -> bool:
        return slam.map.num_keyframes < self.config.atlas.min_keyframes or len(slam.poses) < self.config.atlas.min_frames

    def finish(self) -> None:
        for slam in self.ranked():
            slam.finish()

    def ranked(self) -> list[Slam]:
        """The maps that hold something, the one with most frames first."""
        found = [slam for slam in (*self.maps, self.active) if slam.map.num_keyframes]
        return sorted(found, key=lambda slam: -len(slam.poses))
