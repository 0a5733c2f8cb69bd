# SPDX-License-Identifier: Apache-2.0
"""Tracking, localisation and mapping on one page (Fig. 2a–b of the paper): `Slam.process_frame`, top to bottom."""

from collections import deque
from dataclasses import replace

import numpy as np

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.schur import adjust_accelerated
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.bundle_adjustment.variables import squared_reprojection_errors
from vitamin3d.config import Config
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.reprojection import reprojection_errors
from vitamin3d.geometry.rolling_shutter import NO_MOTION, at_one_moment, fit_image_motion, ideal_pixels
from vitamin3d.geometry.se3 import between, inverse, transform_points
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement
from vitamin3d.mapping.initialization_history import InitializationHistory, TrackedView
from vitamin3d.mapping.keyframe_selection import is_keyframe
from vitamin3d.mapping.landmark_recovery import recover_landmarks, same_landmarks
from vitamin3d.mapping.landmark_statistics import UnitInformation, keyframe_vertices
from vitamin3d.mapping.landmark_triangulation import Rigidity, triangulate_landmarks
from vitamin3d.mapping.map_condensation import Condensation, condense, is_due
from vitamin3d.mapping.map_initialization import add_view, build_first_map
from vitamin3d.mapping.motion_check import MotionCheck
from vitamin3d.mapping.p3p_localization import localize, localize_by, voters
from vitamin3d.mapping.pose_deviation import position_deviation_deg
from vitamin3d.mapping.pose_log import PoseLog
from vitamin3d.mapping.readout_estimation import set_image_motion
from vitamin3d.mapping.relocalization import RememberedKeyframes, is_search_due, relocalize
from vitamin3d.mapping.rotation_tracking import Directions, Turns, rotation_of
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.mapping.two_view_initialization import initialize_from_two_views
from vitamin3d.mapping.visible_landmarks import with_unobserved
from vitamin3d.mapping.window_adjustment import AdjustAtOnce, Adjuster, WindowAdjustment, store_adjustment
from vitamin3d.mapping.window_prior import WindowPrior
from vitamin3d.mapping.window_selection import Window, build_problem, select_frame_window, select_window, store_solution, whole_map
from vitamin3d.tracking.extrema import refine_extrema, select_free_extrema
from vitamin3d.tracking.extrema_tracking import predict_by_dense_flow, predict_by_dominant_flow, track_extrema
from vitamin3d.types import Array, Frame, FrontEndFrame, Localization, MapSnapshot, SlamState, StepTimes, Tracks, Trajectory

IDS_PER_MAP = 1 << 40
"""Tracks of different maps have different ids."""
UNTAKEN_WINDOWS, UNTAKEN_KEYFRAMES = 2, 16
"""Pictures of keyframes that nobody takes are kept for so many windows, or keyframes where that is more."""
MOST_BEQUEATHED_BYTES = 1 << 28
"""Of the pictures that the next map may begin with."""


class Slam:
    """Tracks the extrema of a monocular sequence and maps them (Sec. 2 and 3 of the paper)."""

    def __init__(self, camera: Camera, config: Config, number: int = 0, times: StepTimes | None = None) -> None:
        self.camera, self.config, self.number = camera, config, number
        self.state = SlamState.INITIALIZING
        self.tracks = Tracks.empty()
        self.map = SparseMap()
        self.rigidity = Rigidity()
        self.poses = PoseLog()
        self.times = times or StepTimes()
        self.initialization_reason, self.initialization_retries = "no frame was read", 0
        self.calibration = CalibrationRefinement(camera, config.calibration)
        self.adjuster: Adjuster = AdjustAtOnce()
        self.adjustments_awaited = 0
        self._past = WindowPrior(config)
        self._history = InitializationHistory(config.initialization)
        self._pending_frames: dict[int, Frame] = {}
        self._directions, self._turns, self._num_doubts = Directions(), Turns(), 0
        self._motion_check = MotionCheck(config.motion_check)
        self.heritage: deque[TrackedView] = deque(maxlen=config.atlas.max_heritage)
        """The newest frames, where each continues the one before: the map that follows begins with them."""
        self.is_bent = False
        self._remembered = RememberedKeyframes(config.relocalization)
        self._untaken = max(UNTAKEN_KEYFRAMES, UNTAKEN_WINDOWS * config.window.keyframes)
        self._aside: TrackedView | None = None
        self._turned_frames: list[int] = []
        self._repeats: list[Frame] = []
        self._num_loose = 0
        self.num_lost = 0
        """Frames in a row in which the camera was not found, less one."""
        self._meetings: list[Array] = []
        self._image_motion, self._last_ns = NO_MOTION, 0
        self._last_seen: tuple[tuple[Tracks, Array, Camera], tuple[Tracks, Array]] = (
            (self.tracks, self._image_motion, camera),
            (self.tracks, np.zeros((0, 2))),
        )
        self._before_break: tuple[int, Tracks, int] = -1, self.tracks, 0
        self._next_id = 0
        self._unique_ids, self._num_condensed, self._num_forgotten = np.zeros(0, np.int64), 0, 0
        self._frame_count = 0
        self._newest_frame = -1

    def inherit(self, other: "Slam") -> None:
        """Begins with the camera as another map of the recording has refined it."""
        self.camera = other.camera
        self.calibration.inherit(other.calibration)

    def process_frame(self, front: FrontEndFrame) -> SlamState:
        """One frame, from its curvature and flow to an adjusted map."""
        if front.is_repeat and self.state is SlamState.TRACKING:
            return self._pass_over(front.frame)
        self.take_adjustment()
        self._condense_when_due()
        with self.times.timed("track_extrema"):
            self.tracks = self._track(front)
        if self.map.num_keyframes == 0:
            self._refill_when_due(front)
            with self.times.timed("initialize"):
                self._initialize(front)
        else:
            with self.times.timed("localize"):
                view = self._view_of(front.frame)
                T_cam_world = self._localize(front)
            self._refill_when_due(front)
            self._place_repeats(front.frame.timestamp_ns, T_cam_world)
            self._bequeath(front, view if T_cam_world is None else self._view_of(front.frame))
            if T_cam_world is not None:
                with self.times.timed("map"):
                    self._map(front, T_cam_world)
                    self._directions.note(*self._seen_ids(), self.poses.newest(self.map)[:3, :3], self.camera)
        self._frame_count += 1
        self._newest_frame = front.frame.index
        return self.state

    def _pass_over(self, frame: Frame) -> SlamState:
        """A picture that repeats the one before waits for the next one to tell where the camera was meanwhile."""
        self._repeats.append(replace(frame, image=frame.image[:0], color=None))
        self._newest_frame = frame.index
        return self.state

    def _place_repeats(self, timestamp_ns: int, T_cam_world: Array | None) -> None:
        """Repeated pictures lie on the way between the camera's places before and after them; with none after them, nowhere."""
        repeats, self._repeats = self._repeats, []
        if T_cam_world is None or not repeats:
            return
        before, since_ns = self.poses.newest(self.map), self.poses.newest_timestamp_ns
        for frame in repeats:
            share = (frame.timestamp_ns - since_ns) / max(1, timestamp_ns - since_ns)
            self.poses.add_world(frame, between(before, T_cam_world, share), self.map)

    # --- tracking (Sec. 2) -------------------------------------------------------------------------------------

    def _track(self, front: FrontEndFrame) -> Tracks:
        """Predict (Eq. 4) and climb (Eq. 5), from the frame that this one continues."""
        if front.follows != self._newest_frame and not self._resume(front.follows):
            self._image_motion, self._last_ns = NO_MOTION, front.frame.timestamp_ns
            return Tracks.empty()
        if front.dense_flow is not None:
            predicted = predict_by_dense_flow(self.tracks.pixels, front.dense_flow, self.config.extrema_tracking.flow_reduction)
        else:
            predicted = predict_by_dominant_flow(self.tracks.pixels, front.dominant_flow)
        if self.camera.readout_s or self.calibration.wants_image_motion:
            self._follow_image_motion(front.frame.timestamp_ns, predicted)
        else:
            self._image_motion = NO_MOTION
        return track_extrema(self.tracks, predicted, front.kappa, self.config.extrema_tracking)

    def _resume(self, followed: int | None) -> bool:
        """Takes the tracks up again from before a break, if that is the frame followed; keeps those there are where none is."""
        index, tracks, last_ns = self._before_break
        if followed is not None and followed == index:
            self.tracks, self._last_ns = tracks, last_ns
            self._before_break = -1, Tracks.empty(), 0
            return True
        is_over = index < 0 or self._newest_frame - index > self.config.continuity.max_gap
        if followed is None and len(self.tracks) and is_over:
            self._before_break = self._newest_frame, self.tracks, self._last_ns
        return False

    def _follow_image_motion(self, timestamp_ns: int, predicted: Array) -> None:
        """How fast the image moves, for the rolling shutter; a keyframe just taken gets the mean of before and after."""
        motion = fit_image_motion(self.tracks.pixels, predicted, 1e-9 * (timestamp_ns - self._last_ns), self.camera)
        if self.map.num_keyframes and self.map.timestamps_ns[-1] == self._last_ns:
            set_image_motion(self.map, self.map.num_keyframes - 1, 0.5 * (self._image_motion + motion), self.camera)
        self._image_motion, self._last_ns = motion, timestamp_ns

    def _refill_when_due(self, front: FrontEndFrame) -> None:
        """Every few frames, free extrema become tracks."""
        if self._frame_count % self.config.extrema.refill_interval == 0:
            with self.times.timed("refill"):
                self._refill(front)

    def _refill(self, front: FrontEndFrame) -> None:
        new = select_free_extrema(front.extrema, self.tracks.pixels, front.kappa.shape, self.config.extrema)
        ids, zeros = np.arange(self._next_id, self._next_id + len(new)), np.zeros(len(new), np.int32)
        self._next_id += len(new)
        kappa = front.kappa[new[:, 1], new[:, 0]]
        self.tracks = Tracks.concatenate(self.tracks, Tracks(ids, refine_extrema(front.kappa, new), kappa, zeros, zeros))

    def _seen(self) -> tuple[Tracks, Array]:
        """The tracks that do not coast, and their ideal pixels."""
        at = self.tracks, self._image_motion, self.camera
        if not all(a is b for a, b in zip(at, self._last_seen[0], strict=True)):
            self._last_seen = at, self._compute_seen()
        return self._last_seen[1]

    def _compute_seen(self) -> tuple[Tracks, Array]:
        seen = self.tracks.select(self.tracks.missed == 0)
        pixels = ideal_pixels(seen.pixels, self._image_motion, self.camera)
        valid = np.isfinite(pixels[:, 0])
        return seen.select(valid), pixels[valid]

    def _view_of(self, frame: Frame) -> TrackedView:
        """The newest frame with the tracks seen in it."""
        return TrackedView(frame, *self._seen(), self._image_motion)

    def _seen_ids(self) -> tuple[Array, Array]:
        """Their ids and ideal pixels."""
        seen, pixels = self._seen()
        return seen.ids, pixels

    def _end_tracks(self, ids: Array) -> None:
        if len(ids):
            self.tracks = self.tracks.select(~np.isin(self.tracks.ids, ids, kind="table"))

    # --- initialisation and localisation (Sec. 5.1) ------------------------------------------------------------

    def _initialize(self, front: FrontEndFrame) -> None:
        """The first map from two frames; the frames before it are localised against it."""
        view, aside = self._view_of(front.frame), self._aside
        self._aside = view if front.follows is None and self._history.views else None
        if self._aside is not None:
            return  # of something else, for all that is known until the next frame
        if aside is not None and aside.frame.index == front.follows:
            self._history.append(aside)
        self._turn_on(front.frame)
        self._history.append(view)
        self._begin_map()

    def _bequeath(self, front: FrontEndFrame, view: TrackedView) -> None:
        """What the map that follows this one will begin with, should the camera be lost in the next frame."""
        if front.follows is None:
            self.heritage.clear()
        self.heritage.append(view)
        while len(self.heritage) * view.frame.num_bytes > MOST_BEQUEATHED_BYTES:
            self.heritage.popleft()

    def succeed_to(self, other: "Slam") -> SlamState:
        """Goes on with the newest frames and the tracks of a map in which the camera was lost; at once, if these make a map."""
        views = other.heritage
        self._newest_frame, self._last_ns = other._newest_frame, other._last_ns
        self._next_id = 1 + max(int(view.tracks.ids.max(initial=0)) for view in views)
        for view in views:
            self._history.append(view)
        self.tracks, self._image_motion = views[-1].tracks, views[-1].image_motion
        self._begin_map()
        return self.state

    def _begin_map(self) -> None:
        """From the newest frame and the oldest that shares tracks with it, where they show parallax."""
        ids, pixels_0, pixels_1 = self._history.pair()
        if not self._history.is_worth_a_try(pixels_0, pixels_1):
            return
        attempt = initialize_from_two_views(pixels_0, pixels_1, self.camera, self.config.initialization)
        self._turns.judge(attempt.parallax_deg, self._history.reference_index, self.config.rotation)
        first = build_first_map(attempt.view, ids, self._history.since_reference(), self.camera, self.config) if attempt.view else None
        if first is None:
            self.initialization_reason = attempt.reason or "the first map did not survive its bundle adjustment"
            self.initialization_retries += attempt.is_retry or attempt.view is not None
            return
        self.map, self.state, self.initialization_reason = first.map, SlamState.TRACKING, ""
        self._pending_frames = {k: view.frame for k, view in enumerate(first.keyframe_views)}
        for k, frame in self._pending_frames.items():
            self._remembered.add(k, frame)
        self._log_history()
        self._history.views.clear()
        self._turns, self._directions = Turns(), Directions()

    def _turn_on(self, frame: Frame) -> None:
        """Before there is a map: the rotation since the chain of frames began in which the camera did no more than turn."""
        seen, pixels = self._seen()
        turn = rotation_of(self._directions.of(seen.ids), pixels, seen.ages, self._turns.newest, self.camera, self.config.rotation)
        R = np.eye(3) if turn is None else turn.R_cam_world
        if turn is None or self._turns.ended_before(self._history.reference_index):
            self._turns, self._directions, R = Turns(), Directions(), np.eye(3)
        self._turns.add(frame, R)
        self._directions.note(seen.ids, pixels, R, self.camera)
        has_turned = self._turns.has_turned(self.config.rotation)
        self.state = SlamState.ROTATING if has_turned else SlamState.INITIALIZING

    def _log_history(self) -> None:
        """Localises the frames from before the map against it, going back from it: their tracks were kept."""
        for frame, T_cam_reference in self._turns.since(self.map.frame_indices[0]):
            self.poses.add(frame, 0, T_cam_reference)
        T_next, logged = self.map.T_cam_world[-1], []
        for view in reversed(self._history.views):
            T_cam_world = self._pose_of_history(view, T_next)
            if T_cam_world is not None:
                T_next = T_cam_world
                logged.append((view.frame, T_cam_world))
            elif view.frame.index < self.map.frame_indices[0]:
                break  # what is farther back shares still less with the map
        for frame, T_cam_world in reversed(logged):
            self.poses.add_world(frame, T_cam_world, self.map)

    def _pose_of_history(self, view: TrackedView, T_next: Array) -> Array | None:
        """T_cam_world of a frame from before the map, None where it is not found; before the first keyframe it needs more landmarks."""
        if view.frame.index in self.map.frame_indices:
            return np.asarray(self.map.T_cam_world[self.map.frame_indices.index(view.frame.index)])
        localization, initialization = self.config.localization, self.config.initialization
        if view.frame.index < self.map.frame_indices[0]:
            localization = replace(localization, min_inliers=initialization.min_tracks, min_inlier_ratio=initialization.min_inlier_ratio)
        mapped = self.map.is_mapped(view.tracks.ids)
        points = self.map.points_world[view.tracks.ids[mapped]]
        found = localize(points, view.ideal_pixels[mapped], T_next, self.camera, localization, self.config.seed)
        return found.T_cam_world if found.converged else None

    def _localize(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world of the frame by P3P RANSAC and refinement; ends the tracks that disagree with it."""
        seen, pixels = self._seen()
        mapped = self.map.is_mapped(seen.ids)
        ids, seed = seen.ids[mapped], self.config.seed + front.frame.index
        found = self._pose_of_votes(ids, pixels[mapped], self.poses.predict(self.map), seed)
        fewest = self.config.localization.min_kept_ratio * self.map.is_mapped(self.tracks.ids).sum()
        if not found.converged or found.is_inlier.sum() < fewest:
            return self._rotate(front, seen, pixels)
        self._end_tracks(ids[~found.is_inlier])
        if self._is_loose(ids[found.is_inlier]):
            return self._wait(front, found.T_cam_world)
        if self._turned_frames:
            self._end_turn(found.T_cam_world, self.map.points_world[ids[found.is_inlier]])
        self.state, self._num_doubts = SlamState.TRACKING, 0
        recovery = self.config.recovery
        if recovery.enabled and self._frame_count % recovery.interval == 0 and self._recover(front, found.T_cam_world):
            return self._relocalize(found.T_cam_world)
        return found.T_cam_world

    def _is_loose(self, ids: Array) -> bool:
        """Whether few of the landmarks (N,) ids that localised the camera are known for long: what is new has no say in the scale."""
        localization = self.config.localization
        if self.map.num_keyframes < localization.loose_observations * 2:
            return False
        return bool((self.map.num_observations[ids] >= localization.loose_observations).sum() < localization.min_known)

    def _wait(self, front: FrontEndFrame, T_cam_world: Array) -> Array | None:
        """A frame whose pose hangs on few landmarks is logged, and adds nothing to the map; for a while, then the camera must be found."""
        self._num_loose = self._num_loose + 1 if self.state is SlamState.UNCERTAIN else 1
        if self._num_loose > self.config.localization.max_loose_frames:
            return self._find_camera(front)
        self.state = SlamState.UNCERTAIN
        self.poses.add_world(front.frame, T_cam_world, self.map)
        return None

    def _rotate(self, front: FrontEndFrame, seen: Tracks, pixels: Array) -> Array | None:
        """Where the landmarks have left the picture but it only turned, its frame is logged; else the camera must be found.

        Returns the pose of the latter: nothing is added to the map by a turn.
        """
        before = self.poses.newest(self.map)
        R = None if self.state is SlamState.LOST else self._turned(seen, pixels, before[:3, :3])
        if R is None:
            return self._find_camera(front)
        self.state = SlamState.ROTATING
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3], T_cam_world[:3, 3] = R, R @ before[:3, :3].T @ before[:3, 3]
        self.poses.add_world(front.frame, T_cam_world, self.map)
        self._turned_frames.append(front.frame.index)
        self._directions.note(seen.ids, pixels, R, self.camera)
        if self.config.recovery.enabled and self._frame_count % self.config.recovery.interval == 0:
            self._recover(front, T_cam_world, self.config.relocalization.gate_px)
        return None

    def _end_turn(self, T_cam_world: Array, points_world: Array) -> None:
        """After a turn, with the camera found by landmarks (N, 3): the turn's frames lie on the way from where it was to where it is.

        Where that is far for a turn they are given up. Where the camera was lost in between they stay where they are.
        """
        way = inverse(T_cam_world)[:3, 3] - inverse(self.poses.newest(self.map))[:3, 3]
        depth = float(np.median(transform_points(T_cam_world, points_world)[:, 2]))
        if self.state is SlamState.ROTATING and np.linalg.norm(way) > self.config.rotation.max_shift * depth:
            self.poses.forget(self._turned_frames)
        elif self.state is SlamState.ROTATING:
            for k, index in enumerate(self._turned_frames, start=1):
                self.poses.shift(index, k / (len(self._turned_frames) + 1) * way, self.map)
        self._turned_frames.clear()

    def leave_to(self, other: "Slam") -> bool:
        """What the map that followed knows too is its own: before the camera was lost here it hung on little, there nothing had been lost.

        All since its first frame is, frames of a turn that no landmark ended among them; and what came after the last sound keyframe here
        is nobody's. Whether anything is left.
        """
        self.heritage.clear()
        first = other.poses.first_frame
        last_sound = self._motion_check.last_sound(self.map, self.camera)
        keyframe = min(int(np.searchsorted(self.map.frame_indices, first)) - 1, last_sound)
        if keyframe < 0:
            return False
        self.poses.forget_since(first)
        self._cut_back(keyframe)
        return True

    def _turned(self, seen: Tracks, pixels: Array, R_before: Array) -> Array | None:
        """R_cam_world of a camera that turned on the spot; None where it did not, or seems to travel for a few frames."""
        directions = self._directions.of(seen.ids)
        turn = rotation_of(directions, pixels, seen.ages, R_before, self.camera, self.config.rotation)
        if turn is None or turn.share < self.config.rotation.min_share_in_map:
            return None
        self._num_doubts = self._num_doubts + 1 if turn.is_doubtful else 0
        return None if self._num_doubts > self.config.rotation.max_doubts else turn.R_cam_world

    def _pose_of_votes(self, ids: Array, pixels: Array, T_prior: Array, seed: int = 0) -> Localization:
        """The pose by landmarks (N,) ids at ideal pixels (N, 2), those with many observations deciding."""
        is_voter = voters(self.map.num_observations[ids], self.config.localization)
        points = self.map.points_world[ids]
        return localize_by(is_voter, points, pixels, T_prior, self.camera, self.config.localization, seed)

    def _find_camera(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world of a frame whose tracks broke: descriptors, then a search for the landmarks themselves; or LOST."""
        settings = self.config.relocalization
        self.num_lost = self.num_lost + 1 if self.state is SlamState.LOST else 0
        self.state = SlamState.LOST
        if not settings.enabled or not is_search_due(self.num_lost, settings):
            return None
        strictness = replace(
            self.config.localization,
            min_inliers=settings.min_inliers,
            min_inlier_ratio=settings.min_inlier_ratio,
            ransac_iterations=settings.ransac_iterations,
        )
        found = relocalize(front.frame, self._remembered.to_try(self.num_lost), self.map, self.camera, settings, strictness)
        if not found.converged:
            return None
        self.tracks = Tracks.empty()
        self._recover(front, found.T_cam_world, settings.gate_px)
        T_cam_world = self._relocalize(found.T_cam_world)
        self._recover(front, T_cam_world)
        seen, _ = self._seen()
        if self.map.is_mapped(seen.ids).sum() < self.config.localization.min_inliers:
            return None
        self.state = SlamState.TRACKING
        return self._relocalize(T_cam_world)

    def _recover(self, front: FrontEndFrame, T_cam_world: Array, gate_px: float | None = None) -> int:
        """Takes up landmarks that came back into view; how many."""
        before = self.tracks.ids
        image, recovery, motion = front.frame.image, self.config.recovery, self._image_motion
        recovery = recovery if gate_px is None else replace(recovery, gate_px=gate_px)
        self.tracks, meetings = recover_landmarks(
            self.tracks, self.map, image, front.kappa, motion, T_cam_world, self.camera, recovery, front.noise
        )
        self._meetings.append(meetings)
        return int((~np.isin(self.tracks.ids, before, kind="table")).sum())

    def _relocalize(self, T_cam_world: Array) -> Array:
        """The pose refined with the landmarks that were found again."""
        seen, pixels = self._seen()
        mapped = self.map.is_mapped(seen.ids)
        ids = seen.ids[mapped]
        found = self._pose_of_votes(ids, pixels[mapped], T_cam_world)
        if not found.converged:
            return T_cam_world
        self._end_tracks(ids[~found.is_inlier])
        return found.T_cam_world

    # --- mapping (Sec. 3) --------------------------------------------------------------------------------------

    def _map(self, front: FrontEndFrame, T_cam_world: Array) -> None:
        """Keyframes, landmarks, and bundle adjustment on every frame (Eq. 11–12)."""
        if self._is_keyframe(front.frame):
            T_cam_world = self._after_adjustment(T_cam_world)
            self._merge_landmarks(T_cam_world)
            keyframe = self._add_keyframe(front, T_cam_world)
            triangulate_landmarks(self.map, self.camera, self.config.triangulation, self.rigidity)
            if keyframe % self.config.bundle_adjustment.keyframe_interval == 0:
                self._adjust_window()
            self._refine_calibration_when_due()
            self.poses.add(front.frame, keyframe, np.eye(4))
            if self._motion_check.is_due(keyframe) and self._motion_check.is_bent(self.map, self.camera):
                self._retreat(self._motion_check.last_sound(self.map, self.camera))
        else:
            T_cam_world = self._adjust_with_frame(T_cam_world)
            self.poses.add_world(front.frame, T_cam_world, self.map)

    def _retreat(self, keyframe: int) -> None:
        """Forgets all since a keyframe, which the map that follows inherits; the camera is lost in this one."""
        self.take_adjustment(wait=True)
        self.is_bent, self.state = True, SlamState.LOST
        self._cut_back(keyframe)

    def _cut_back(self, keyframe: int) -> None:
        """Forgets what came after a keyframe; the tracks end."""
        if keyframe + 1 < self.map.num_keyframes:
            self.poses.forget_since(self.map.frame_indices[keyframe + 1])
        self.tracks, self._meetings = Tracks.empty(), []
        kept_keyframes = np.arange(keyframe + 1)
        kept, kept_ids = self.map.condensed(kept_keyframes, np.zeros(0, np.int64))
        self._become(Condensation(kept, kept_keyframes, kept_ids))

    def _is_keyframe(self, frame: Frame) -> bool:
        seen, pixels = self._seen()
        last = self.map.num_keyframes - 1
        rows, mapped = self.map.observations_of(last), self.map.is_mapped(seen.ids)
        count = (self.map.is_mapped(self.map.obs_landmark[rows]) & self.map.obs_valid[rows]).sum()
        now, then = pixels[mapped], self.map.last_observation[seen.ids[mapped]]
        both = (then >= rows.start) & self.map.obs_valid[then]
        gap = frame.index - self.map.frame_indices[last]
        return is_keyframe(self.map.obs_pixels[then[both]], now[both], int(count), gap, self.config.keyframes)

    def _add_keyframe(self, front: FrontEndFrame, T_cam_world: Array) -> int:
        deviation = self._position_deviation_deg(T_cam_world)
        keyframe = add_view(self.map, self._view_of(front.frame), T_cam_world, deviation)
        self._pending_frames[keyframe] = front.frame
        self._pending_frames.pop(keyframe - self._untaken, None)
        self._remembered.add(keyframe, front.frame)
        return keyframe

    def _position_deviation_deg(self, T_cam_world: Array) -> float:
        """Of the camera's place by the landmarks that vote and agree with it."""
        seen, pixels = self._seen()
        ids = seen.ids
        mapped = np.flatnonzero(self.map.is_mapped(ids))
        voting = mapped[voters(self.map.num_observations[ids[mapped]], self.config.localization)]
        points = self.map.points_world[ids[voting]]
        errors = reprojection_errors(T_cam_world, points, pixels[voting], self.camera.intrinsics)
        agrees = errors < self.config.localization.outlier_px
        return position_deviation_deg(transform_points(T_cam_world, points[agrees]), errors[agrees], self.camera)

    def _merge_landmarks(self, T_cam_world: Array) -> None:
        """Landmarks that met tracked ones since the last keyframe and are the same become one, the older."""
        meetings = np.concatenate([*self._meetings, np.zeros((0, 2), np.int64)])
        pairs = same_landmarks(meetings, self.tracks, self.map, T_cam_world, self.config.recovery.merge_distance)
        self._meetings.clear()
        if len(pairs):
            self.map.merge_landmarks(pairs[:, 0], pairs[:, 1])
            self.tracks = self.tracks.renamed(pairs[:, 1], pairs[:, 0])

    def _adjust_window(self) -> None:
        """The keyframe's adjustment of the window and its landmarks, anchored."""
        if self.config.window.past == "prior":
            window, problem = self._past.advance(self.map, self.camera)
        else:
            window = select_window(self.map, self.config.window)
            problem = build_problem(self.map, window)
        prior = self._past.prior
        self.adjuster.begin(lambda: self._solved(window, problem, prior))
        self.take_adjustment()

    def _solved(self, window: Window, problem: BundleProblem, prior: CameraPrior | None) -> WindowAdjustment:
        """Runs on the adjuster's thread."""
        with self.times.timed("bundle_adjustment_keyframe"):
            return WindowAdjustment(window, adjust_bundle(problem, self.camera, self.config.bundle_adjustment, prior)[0])

    def _after_adjustment(self, T_cam_world: Array) -> Array:
        """A keyframe's T_cam_world in the map after the adjustment begun before it, which is waited for: else the map would drift."""
        if not self.adjuster.is_busy:
            return T_cam_world
        self.adjustments_awaited += 1
        T_cam_keyframe = T_cam_world @ inverse(self.map.T_cam_world[-1])
        self.take_adjustment(wait=True)
        return self._relocalize(T_cam_keyframe @ self.map.T_cam_world[-1])

    def take_adjustment(self, wait: bool = False) -> None:
        """The window that was adjusted meanwhile enters the map; its outliers leave the map and the tracks."""
        done = self.adjuster.take(wait)
        if done is not None:
            store_adjustment(self.map, done)
            self._remove_outliers(done.window, done.solved, self.config.bundle_adjustment.outlier_px)

    def _condense_when_due(self) -> None:
        """Once in a while the map forgets what it can do without; ids and keyframes are numbered anew."""
        new_ids = self._next_id - self._num_condensed
        if self.map.num_keyframes == 0 or not is_due(self.map, new_ids, self.config.memory):
            return
        with self.times.timed("condense"):
            self.take_adjustment(wait=True)
            needed = np.concatenate([self.tracks.ids, *(pair.ravel() for pair in self._meetings)])
            self._become(condense(self.map, np.unique(needed), self._untaken, self.config.memory))
            self.heritage.clear()  # their tracks have other ids

    def _become(self, done: Condensation) -> None:
        """Takes a smaller map; ids and keyframes are numbered anew."""
        self.poses.move_to(done.kept_keyframes, self.map)
        born = self.unique_ids(np.append(done.kept_ids, self._next_id)) - self.number * IDS_PER_MAP
        self._unique_ids, self._num_forgotten = born[:-1], int(born[-1]) - len(done.kept_ids)
        renamed = np.searchsorted(done.kept_ids, self.tracks.ids)
        self.tracks = replace(self.tracks, ids=renamed)
        self._meetings = [np.searchsorted(done.kept_ids, pair) for pair in self._meetings]
        is_kept = np.isin(np.arange(self.map.num_keyframes), done.kept_keyframes)
        self._pending_frames = {int(np.searchsorted(done.kept_keyframes, k)): f for k, f in self._pending_frames.items() if is_kept[k]}
        self._directions = self._directions.renamed(done.kept_ids)
        self._remembered.move_to(done.kept_keyframes)
        self._motion_check.move_to(done.kept_keyframes)
        self._past.forget()
        self.map, self._next_id, self._num_condensed = done.map, len(done.kept_ids), len(done.kept_ids)

    def unique_ids(self, ids: Array) -> Array:
        """The ids (N,) that tracks had at their birth, which the map's memory does not reuse."""
        known = ids < self._num_condensed
        out = ids + self._num_forgotten
        out[known] = self._unique_ids[ids[known]]
        return np.asarray(out + self.number * IDS_PER_MAP)

    def _refine_calibration_when_due(self) -> None:
        if self.calibration.is_due(self.map.num_keyframes):
            self._refine_calibration()

    def _refine_calibration(self) -> None:
        """The camera's parameters from all of the map (or as they were); the map moves along."""
        with self.times.timed("self_calibration"):
            self.camera = self.calibration.refine(self.map, self.camera)
            self._past.forget()

    def _remove_outliers(self, window: Window, solved: BundleProblem, limit_px: float) -> None:
        is_outlier = squared_reprojection_errors(solved, self.camera) > limit_px**2
        is_newest = solved.obs_camera == window.num_adjusted - 1
        self.map.remove_observations(solved.obs_rows[is_outlier])
        ended = solved.landmark_ids[solved.obs_point[is_outlier & is_newest]]
        self._end_tracks(ended)

    def _adjust_with_frame(self, T_cam_world: Array) -> Array:
        """A few sweeps of subspace Gauss–Newton over the newest frame, keyframes and its landmarks; the frame's pose."""
        adjustment = self.config.bundle_adjustment
        if adjustment.sweeps_per_frame == 0:
            return T_cam_world
        with self.times.timed("bundle_adjustment_frame"):
            seen, pixels = self._seen()
            mapped = self.map.is_mapped(seen.ids)
            window = select_frame_window(self.map, adjustment.frame_keyframes, adjustment.frame_anchors)
            problem = build_problem(self.map, window, (T_cam_world, seen.ids[mapped], pixels[mapped]))
            solved, _ = adjust_subspace(problem, self.camera, adjustment.sigma_px, adjustment.sweeps_per_frame)
            store_solution(self.map, window, solved)
        return np.asarray(solved.T_cam_world[-1])

    def finish(self) -> None:
        """The adjustment of the whole map at the end of a recording; the poses of all frames move along."""
        if self._repeats:
            self._place_repeats(self._repeats[-1].timestamp_ns, self.poses.newest(self.map))  # and the camera rests, for all that is known
        final = self.config.final_adjustment
        if not final.enabled or not 2 < self.map.num_keyframes <= final.max_keyframes:
            return
        if self.calibration.is_enabled:
            self._refine_calibration()
        with self.times.timed("final_adjustment"):
            everything = whole_map(self.map)
            problem = build_problem(self.map, everything)
            solved, _ = adjust_accelerated(problem, self.camera, final.sigma_px, final.iterations, final.relative_gain)
            store_solution(self.map, everything, solved)
            self._remove_outliers(everything, solved, final.outlier_px)

    # --- what leaves ---------------------------------------------------------------------------------------------

    def take_settled_keyframes(self, everything: bool = False) -> list[tuple[int, Frame]]:
        """The keyframes that settled since the last call (or all that remain), each once, with their frames."""
        window, count = self.config.window, self.map.num_keyframes
        settled = count if everything else count - (window.settled_keyframes or window.keyframes)
        rests_since = self._newest_frame - window.settled_frames if window.settled_frames else -1
        ready = sorted(k for k, frame in self._pending_frames.items() if k < settled or frame.index <= rests_since)
        return [(k, self._pending_frames.pop(k)) for k in ready]

    def snapshot(self, keyframe: int, frame: Frame, by_id: UnitInformation | None = None) -> MapSnapshot:
        """A keyframe with the depths of its landmarks as the map has them now; its picture as if read at one moment.

        `by_id` is the map's `information_by_id`, for many keyframes of a map that is finished.
        """
        at = self.map, keyframe, self.camera, self.config.snapshot, by_id
        vertices = keyframe_vertices(*at)
        if self.config.snapshot.unobserved:
            vertices = with_unobserved(vertices, *at)
        motion = self.map.image_motions[keyframe]
        return MapSnapshot(at_one_moment(frame, motion, self.camera), self.map.clone_pose(keyframe), *vertices, self.number)

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of all localised frames."""
        return self.poses.trajectory(self.map)

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""
        return Trajectory(np.array(self.map.timestamps_ns, np.int64), inverse(self.map.T_cam_world))
