# SPDX-License-Identifier: Apache-2.0
"""The maps of a run: what begins, keeps and ends them.

Where the camera is lost, a new map begins beside the search for the old one. Whichever comes first goes on: the old map with the
camera found in it, or the new one once it has held for a while. A map that was lost while it was young is dropped then.
"""

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.mapping.window_adjustment import SharedAdjuster
from vitamin3d.slam import Slam
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.succession import leave, succeed
from vitamin3d.tracking.tracker import TrackIds
from vitamin3d.types import Frame, FrameNote, FrontEndFrame, SlamState, StepTimes


class Atlas:
    """Never gives up: tracks a sequence through as many maps as it takes."""

    def __init__(self, camera: Camera, config: Config, steps: SlamSteps | None = None) -> None:
        self.camera, self.config, self.steps = camera, config, steps
        self.times = StepTimes()
        self.notes: list[FrameNote] = []
        """One per frame processed."""
        self.adjuster = SharedAdjuster()
        """Of the windows of all maps."""
        self._track_ids = TrackIds()
        self._born = 0
        self.left: list[Slam] = []
        """Maps in which the camera was lost and that another one followed."""
        self.successor: Slam | None = None
        """The next one, while the camera is lost in the active one."""
        self.active = self._new_map()
        """The map in which the camera is tracked, or was last."""
        self._frames_held = 0
        """In a row, in which the camera was found in it."""

    @property
    def current(self) -> Slam:
        """The map for which the newest frame was tracked."""
        return self.active if self.successor is None or self._frames_held else self.successor

    def process_frame(self, front: FrontEndFrame) -> SlamState:
        """One frame: tracked in the active map, or in the one that begins where that is lost."""
        state = self._tracked(front)
        self.notes.append(self._note(front, state))
        return state

    def _tracked(self, front: FrontEndFrame) -> SlamState:
        if self._is_false(self.active):
            self.active.mapper.take_adjustment(wait=True)
            self.active = self._new_map()
        state = self.active.process_frame(front)
        is_held = state not in (SlamState.LOST, SlamState.ROTATING) or self.active.map.num_keyframes == 0
        self._frames_held = self._frames_held + 1 if is_held else 0
        if is_held:
            self._keep_successor_ready(front)
            return state
        self.active.mapper.take_adjustment(wait=True)  # both maps may have one adjuster, and it does one thing at a time
        return self._take_over(front) if self.active.is_bent else self._succeed(front, state)

    def _keep_successor_ready(self, front: FrontEndFrame) -> None:
        """A camera that was found again may be lost again soon: the next map goes on beside for a while."""
        if self.successor is None or self._frames_held > self.config.atlas.frames_beside:
            self.successor = None
            return
        self.active.mapper.take_adjustment(wait=True)
        state = self.successor.process_frame(front)
        self.successor.mapper.take_adjustment(wait=True)
        if state is SlamState.LOST or self._is_false(self.successor):
            self.successor = None

    def _take_over(self, front: FrontEndFrame) -> SlamState:
        """A bent map ends for good: near the bend nothing in it is certain. Next is the one that is ready, or begins with its tracks."""
        bent, ready, self.successor = self.active, self.successor, None
        self.left += [] if self._is_young(bent) else [bent]
        if ready is not None and ready.map.num_keyframes and ready.process_frame(front) is SlamState.TRACKING:
            self.active = ready
        else:
            self.active = self._new_map()
            succeed(self.active, bent)
        bent.heritage.views.clear()
        return self.active.state

    def _succeed(self, front: FrontEndFrame, state: SlamState) -> SlamState:
        """The frame in the successor, which becomes the active map when it has held for a while."""
        if self.successor is None:
            self.successor, state = self._begun(self.active, front)
        else:
            state = self.successor.process_frame(front)
        self.successor.mapper.take_adjustment(wait=True)
        if state is SlamState.LOST or self._is_false(self.successor):
            self.successor, state = self._begun(self.successor if state is SlamState.LOST else None, front)
        if state is SlamState.TRACKING and self._has_held(self.successor):
            self._hand_over_to(self.successor)
        return state

    def _hand_over_to(self, slam: Slam) -> None:
        is_left = leave(self.active, slam) and not self._is_young(self.active)
        self.left += [self.active] if is_left else []
        self.active, self.successor = slam, None

    def _begun(self, other: Slam | None, front: FrontEndFrame) -> tuple[Slam, SlamState]:
        """A new map and its state after the frame: with the tracks of one in which the camera was lost, if they reach the frame."""
        slam = self._new_map()
        if other is None or len(other.heritage.views) < 2:
            return slam, slam.process_frame(front)
        return slam, succeed(slam, other)

    def _has_held(self, slam: Slam) -> bool:
        """Whether a map that is not young has enough frames that the active one does not have."""
        return not self._is_young(slam) and slam.poses.num_beyond(self.active.poses) >= self.config.atlas.min_frames

    def _new_map(self) -> Slam:
        slam = Slam(self.camera, self.config, self._born, self.times, self._track_ids, self.adjuster, self.steps)
        older = [other for other in self._all() if not self._is_young(other)] if self._born else []
        if older:
            slam.mapper.inherit(max(older, key=lambda other: len(other.poses)).mapper)
        self._born += 1
        return slam

    def _is_young(self, slam: Slam) -> bool:
        """Whether a map holds too little to be kept, or something that is not one rigid scene."""
        atlas = self.config.atlas
        is_small = slam.map.num_keyframes < atlas.min_keyframes or len(slam.poses) < atlas.min_frames
        return is_small or self._is_false(slam)

    def _is_false(self, slam: Slam) -> bool:
        """Whether most tracks that show parallax contradict the map: it may be that of something that moves."""
        rigidity = slam.mapper.rigidity
        return rigidity.num_tracks >= self.config.atlas.judged_tracks and rigidity.share < self.config.atlas.min_rigid_share

    def _note(self, front: FrontEndFrame, state: SlamState) -> FrameNote:
        flow, slam, frame = front.dense_flow, self.current, front.frame
        motion = 0.0 if flow is None else self.config.extrema_tracking.flow_reduction * float(np.median(np.hypot(*flow[::8, ::8].T)))
        small = frame.image[::4, ::4]
        num_tracks = int((slam.tracks.missed == 0).sum())
        return FrameNote(
            frame.index, frame.timestamp_ns, state, slam.number, len(front.extrema), num_tracks, float(small.std()), float(small.mean()),
            front.follows is not None, motion, slam.initializer.reason,
        )  # fmt: skip

    def take_adjustment(self, wait: bool = False) -> None:
        """The window that was adjusted meanwhile enters the active map."""
        self.active.mapper.take_adjustment(wait)

    @property
    def adjustments_awaited(self) -> int:
        return sum(slam.mapper.adjustment.num_awaited for slam in self._all())

    def finish(self) -> None:
        """The adjustment of each whole map at the end of a recording; the next map goes on if there is one."""
        if self.successor is not None and not self._frames_held and not self._is_young(self.successor):
            self._hand_over_to(self.successor)
        for slam in self.ranked():
            slam.finish()

    def ranked(self) -> list[Slam]:
        """The maps that hold something, the one with most frames first."""
        found = [slam for slam in self._all() if slam.map.num_keyframes]
        return sorted(found, key=lambda slam: (-len(slam.poses), slam.number))

    def _all(self) -> list[Slam]:
        return [*self.left, self.active, *([] if self.successor is None or self._frames_held else [self.successor])]

    def take_settled_keyframes(self, everything: bool = False) -> list[tuple[Slam, int, Frame]]:
        """Map, keyframe and picture of those that settled since the last call (or all that remain), each once."""
        found: list[tuple[Slam, int, Frame]] = []
        for slam in self._all():
            if everything or not (slam is self.successor or self._is_young(slam)):
                found += [(slam, k, frame) for k, frame in slam.take_settled_keyframes(everything or slam in self.left)]
        return found
