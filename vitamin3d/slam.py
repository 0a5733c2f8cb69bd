# SPDX-License-Identifier: Apache-2.0
"""Tracking, localisation and mapping on one page (Fig. 2a–b of the paper): `Slam.process_frame`, top to bottom."""

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.initialization.heritage import Heritage
from vitamin3d.initialization.initializer import Beginning, Initializer
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.localization.repeated_pictures import RepeatedPictures
from vitamin3d.mapping.keyframe_handover import snapshot_of
from vitamin3d.mapping.landmark_statistics import UnitInformation
from vitamin3d.mapping.map_adjustment import MapAdjustment
from vitamin3d.mapping.map_condensation import Condensation
from vitamin3d.mapping.mapper import Mapper
from vitamin3d.mapping.window_adjustment import AdjustAtOnce, Adjuster
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.sparse_map import SparseMap
from vitamin3d.tracking.tracker import TrackIds
from vitamin3d.types import Array, Frame, FrontEndFrame, MapSnapshot, SlamState, StepTimes, Tracks, Trajectory


class Slam:
    """Tracks the extrema of a monocular sequence and maps them (Sec. 2 and 3 of the paper), in one map.

    Args:
        number: of the map, in the order of their births.
        ids: of the run's tracks.
        adjuster: of the run; None: windows are adjusted at once.
        steps: others than those of the paper.
    """

    def __init__(
        self, camera: Camera, config: Config, number: int = 0, times: StepTimes | None = None, ids: TrackIds | None = None,
        adjuster: Adjuster | None = None, steps: SlamSteps | None = None,
    ) -> None:  # fmt: skip
        self.config, self.number, self.times = config, number, times or StepTimes()
        self.poses = PoseLog()
        steps = steps or SlamSteps()
        self.tracker = steps.tracker(camera, config, ids or TrackIds())
        self.mapper = Mapper(camera, self.tracker, config, MapAdjustment(config, adjuster or AdjustAtOnce(), self.times, steps.solve))
        self.localizer = steps.localizer(self.tracker, self.mapper, self.poses, config)
        self.initializer = Initializer(self.tracker, config)
        self.heritage = Heritage(config.atlas.max_heritage)
        self.is_bent = False
        """The map's newest part contradicted its own tracks, and was cut off."""
        self._repeats = RepeatedPictures()

    def process_frame(self, front: FrontEndFrame) -> SlamState:
        """One frame, from its curvature and flow to an adjusted map: track, locate, map."""
        if front.is_repeat and self.state is SlamState.TRACKING:
            return self._pass_over(front.frame)  # the next picture tells where the camera was meanwhile
        self.mapper.take_adjustment()
        self._become(self.mapper.condensed_when_due())
        self._track(front)
        if self.map.num_keyframes == 0:
            self._initialize(front)
        else:
            T_cam_world = self._locate(front)
            if self.state is SlamState.TRACKING and T_cam_world is not None:
                self._map(front, T_cam_world)
            elif T_cam_world is not None:  # a turn, or few landmarks: good enough for the frame, nothing for the map
                self.poses.add_world(front.frame, T_cam_world, self.map)
        self.tracker.end_frame(front.frame)
        return self.state

    def _track(self, front: FrontEndFrame) -> None:
        """Predict (Eq. 4) and climb (Eq. 5)."""
        with self.times.timed("track_extrema"):
            motion_before = self.tracker.follow(front, self.mapper.wants_image_motion)
            if motion_before is not None:
                self.mapper.note_image_motion(*motion_before)

    def _pass_over(self, frame: Frame) -> SlamState:
        self._repeats.add(frame)
        self.tracker.pass_over(frame)
        return self.state

    def _initialize(self, front: FrontEndFrame) -> None:
        """The first map from two frames; the frames before it are localised against it."""
        self._refill_when_due(front)
        with self.times.timed("initialize"):
            self.begin(self.initializer.try_frame(front, self.camera))

    def begin(self, beginning: Beginning | None) -> None:
        """Takes the first map, if there is one."""
        if beginning is None:
            return
        self.mapper.begin(beginning.map, beginning.keyframes)
        self.localizer.begin(beginning.keyframes)
        for frame, T_cam_keyframe in beginning.turned:
            self.poses.add(frame, 0, T_cam_keyframe)
        for frame, T_cam_world in beginning.placed:
            self.poses.add_world(frame, T_cam_world, self.map)

    def _locate(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world of the frame (P3P), None where the camera is lost."""
        with self.times.timed("localize"):
            view = self.tracker.view(front.frame)
            T_cam_world = self.localizer.locate(front)
        self._refill_when_due(front)
        is_tracked = self.state is SlamState.TRACKING and T_cam_world is not None
        self._repeats.place(front.frame.timestamp_ns, T_cam_world if is_tracked else None, self.poses, self.map)
        self.heritage.add(self.tracker.view(front.frame) if is_tracked else view, continues=front.follows is not None)
        return T_cam_world

    def _map(self, front: FrontEndFrame, T_cam_world: Array) -> None:
        """Keyframes, landmarks, and bundle adjustment on every frame (Eq. 11–12)."""
        with self.times.timed("map"):
            if self.mapper.is_keyframe(front.frame):
                self._add_keyframe(front, T_cam_world)
            else:
                self.poses.add_world(front.frame, self.mapper.adjust_with_frame(T_cam_world), self.map)
            self.localizer.note_directions()

    def _add_keyframe(self, front: FrontEndFrame, T_cam_world: Array) -> None:
        """What the keyframe before began is waited for: else the map would drift."""
        if self.mapper.is_adjusting:
            T_cam_world = self.localizer.refine(self.mapper.await_adjustment(T_cam_world))
        self.mapper.merge_landmarks(T_cam_world)
        keyframe = self.mapper.add_keyframe(front, T_cam_world, self.localizer.position_deviation_deg(T_cam_world))
        self.localizer.remember(keyframe, front.frame)
        self.poses.add(front.frame, keyframe, np.eye(4))
        if self.mapper.is_bent():
            self._retreat(self.mapper.last_sound_keyframe())

    def _retreat(self, keyframe: int) -> None:
        """Forgets all since a keyframe, which the map that follows inherits; the camera is lost in this one."""
        self.mapper.take_adjustment(wait=True)
        self.is_bent = True
        self.localizer.lose()
        self.cut_back(keyframe)

    def cut_back(self, keyframe: int) -> None:
        """Forgets what came after a keyframe; the tracks end."""
        if keyframe + 1 < self.map.num_keyframes:
            self.poses.forget_since(self.map.frame_indices[keyframe + 1])
        self._become(self.mapper.cut_back(keyframe))

    def _become(self, done: Condensation | None) -> None:
        """Takes a smaller map; keyframes are numbered anew."""
        if done is not None:
            self.poses.move_to(done.kept_keyframes, self.map)
            self.localizer.forget(done.kept_keyframes, done.map.remembered_ids)
            self.mapper.become(done)

    def _refill_when_due(self, front: FrontEndFrame) -> None:
        if self.tracker.is_refill_due:
            with self.times.timed("refill"):
                self.tracker.refill(front)

    # --- what leaves -------------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """The adjustment of the whole map at the end of a recording; the poses of all frames move along."""
        if self.map.num_keyframes:
            self._repeats.finish(self.poses, self.map)
        self.mapper.finish()

    def take_settled_keyframes(self, everything: bool = False) -> list[tuple[int, Frame]]:
        """The keyframes that settled since the last call (or all that remain), each once, with their frames."""
        return self.mapper.handover.take_settled(self.map.num_keyframes, self.tracker.newest_frame, everything)

    def snapshot(self, keyframe: int, frame: Frame, by_row: UnitInformation | None = None) -> MapSnapshot:
        """A keyframe with the depths of its landmarks as the map has them now; its picture as if read at one moment.

        `by_row` is the map's `information_by_row`, for many keyframes of a map that is finished.
        """
        return snapshot_of(self.map, keyframe, frame, self.camera, self.config, self.number, by_row)

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of all localised frames."""
        return self.poses.trajectory(self.map)

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""
        return Trajectory(np.array(self.map.timestamps_ns, np.int64), inverse(self.map.T_cam_world))

    @property
    def state(self) -> SlamState:
        """What the camera is known to do after the newest frame."""
        return self.localizer.state if self.map.num_keyframes else self.initializer.state

    @property
    def map(self) -> SparseMap:
        return self.mapper.map

    @property
    def camera(self) -> Camera:
        return self.mapper.camera

    @property
    def tracks(self) -> Tracks:
        return self.tracker.tracks
