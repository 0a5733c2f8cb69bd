# SPDX-License-Identifier: Apache-2.0
"""Where the camera is, how well that is supported, and what to do when it is not found (Sec. 5.1)."""

from dataclasses import replace

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.reprojection import reprojection_errors
from vitamin3d.geometry.se3 import inverse, transform_points
from vitamin3d.localization.p3p_localization import localize_by, voters
from vitamin3d.localization.pose_deviation import position_deviation_deg
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.localization.relocalization import RememberedKeyframes, is_search_due, relocalize
from vitamin3d.localization.rotation_tracking import Directions, rotation_of
from vitamin3d.steps import LandmarkMapper, LandmarkTracker
from vitamin3d.types import Array, Frame, FrontEndFrame, Localization, SlamState, Tracks


class Localizer:
    """Finds the camera of each frame in one map; `state` says how. What its methods do is said by `CameraLocalizer`.

    Args:
        tracker: its tracks that contradict a pose are ended.
        mapper: whose map it is, and who finds landmarks again that come back into view.
        poses: of the frames before; those of a turn are mended there.
    """

    def __init__(self, tracker: LandmarkTracker, mapper: LandmarkMapper, poses: PoseLog, config: Config) -> None:
        self.tracker, self.mapper, self.poses, self.config = tracker, mapper, poses, config
        self.state = SlamState.TRACKING
        self._directions = Directions(tracker.first_id)
        self._remembered = RememberedKeyframes(config.relocalization)
        self._turned_frames: list[int] = []
        self._num_doubts, self._num_loose = 0, 0
        self._num_lost = 0
        """Frames in a row in which the camera was not found, less one."""

    def locate(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world (4, 4) of a frame by P3P RANSAC and refinement; ends the tracks that disagree with it.

        None where the camera is lost. Where the state is not TRACKING afterwards, the pose is good enough for the frame alone.
        """
        seen, pixels = self.tracker.seen()
        sparse_map = self.mapper.map
        is_mapped, rows = sparse_map.mapped(seen.ids)
        found = self._pose_of_votes(rows, pixels[is_mapped], self.poses.predict(sparse_map), self.config.seed + front.frame.index)
        fewest = self.config.localization.min_kept_ratio * sparse_map.mapped(self.tracker.tracks.ids)[0].sum()
        if not found.converged or found.is_inlier.sum() < fewest:
            return self._rotate(front, seen, pixels)
        self.tracker.end(seen.ids[is_mapped][~found.is_inlier])
        known = rows[found.is_inlier]
        if self._is_loose(known):
            return self._wait(front, found.T_cam_world)
        if self._turned_frames:
            self._end_turn(found.T_cam_world, sparse_map.points_world[known])
        self.state, self._num_doubts = SlamState.TRACKING, 0
        if self._is_recovery_due and self.mapper.recover(front, found.T_cam_world):
            return self.refine(found.T_cam_world)
        return found.T_cam_world

    @property
    def _is_recovery_due(self) -> bool:
        recovery = self.config.recovery
        return recovery.enabled and self.tracker.frame_count % recovery.interval == 0

    def _pose_of_votes(self, rows: Array, pixels: Array, T_prior: Array, seed: int = 0) -> Localization:
        """The pose by the landmarks in rows (N,) at ideal pixels (N, 2), those with many observations deciding."""
        is_voter = voters(self.mapper.map.num_observations[rows], self.config.localization)
        points = self.mapper.map.points_world[rows]
        return localize_by(is_voter, points, pixels, T_prior, self.mapper.camera, self.config.localization, seed)

    def refine(self, T_cam_world: Array) -> Array:
        """The pose refined with all landmarks that are tracked now; ends those that disagree."""
        seen, pixels = self.tracker.seen()
        is_mapped, rows = self.mapper.map.mapped(seen.ids)
        found = self._pose_of_votes(rows, pixels[is_mapped], T_cam_world)
        if not found.converged:
            return T_cam_world
        self.tracker.end(seen.ids[is_mapped][~found.is_inlier])
        return found.T_cam_world

    def position_deviation_deg(self, T_cam_world: Array) -> float:
        seen, pixels = self.tracker.seen()
        sparse_map, camera = self.mapper.map, self.mapper.camera
        is_mapped, rows = sparse_map.mapped(seen.ids)
        voting = voters(sparse_map.num_observations[rows], self.config.localization)
        points = sparse_map.points_world[rows[voting]]
        errors = reprojection_errors(T_cam_world, points, pixels[is_mapped][voting], camera.intrinsics)
        agrees = errors < self.config.localization.outlier_px
        return position_deviation_deg(transform_points(T_cam_world, points[agrees]), errors[agrees], camera)

    # --- health ----------------------------------------------------------------------------------------------------

    def _is_loose(self, rows: Array) -> bool:
        """Whether few of the landmarks (N,) that localised the camera are known for long: what is new has no say in the scale."""
        localization, sparse_map = self.config.localization, self.mapper.map
        if sparse_map.num_keyframes < localization.loose_observations * 2:
            return False
        return bool((sparse_map.num_observations[rows] >= localization.loose_observations).sum() < localization.min_known)

    def _wait(self, front: FrontEndFrame, T_cam_world: Array) -> Array | None:
        """A frame whose pose hangs on few landmarks adds nothing to the map; for a while, then the camera must be found."""
        self._num_loose = self._num_loose + 1 if self.state is SlamState.UNCERTAIN else 1
        if self._num_loose > self.config.localization.max_loose_frames:
            return self._find_camera(front)
        self.state = SlamState.UNCERTAIN
        return T_cam_world

    # --- a camera that only turns ------------------------------------------------------------------------------------

    def _rotate(self, front: FrontEndFrame, seen: Tracks, pixels: Array) -> Array | None:
        """Where the landmarks have left the picture but it only turned, the camera is where it was; else it must be found."""
        before = self.poses.newest(self.mapper.map)
        R = None if self.state is SlamState.LOST else self._turned(seen, pixels, before[:3, :3])
        if R is None:
            return self._find_camera(front)
        self.state = SlamState.ROTATING
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3], T_cam_world[:3, 3] = R, R @ before[:3, :3].T @ before[:3, 3]
        self._turned_frames.append(front.frame.index)
        self._directions.note(seen.ids, pixels, R, self.mapper.camera)
        if self._is_recovery_due:
            self.mapper.recover(front, T_cam_world, self.config.relocalization.gate_px)
        return T_cam_world

    def _turned(self, seen: Tracks, pixels: Array, R_before: Array) -> Array | None:
        """R_cam_world of a camera that turned on the spot; None where it did not, or seems to travel for a few frames."""
        directions = self._directions.of(seen.ids)
        turn = rotation_of(directions, pixels, seen.ages, R_before, self.mapper.camera, self.config.rotation)
        if turn is None or turn.share < self.config.rotation.min_share_in_map:
            return None
        self._num_doubts = self._num_doubts + 1 if turn.is_doubtful else 0
        return None if self._num_doubts > self.config.rotation.max_doubts else turn.R_cam_world

    def _end_turn(self, T_cam_world: Array, points_world: Array) -> None:
        """After a turn, with the camera found by landmarks (N, 3): the turn's frames lie on the way from where it was to where it is.

        Where that is far for a turn they are given up. Where the camera was lost in between they stay where they are.
        """
        sparse_map = self.mapper.map
        way = inverse(T_cam_world)[:3, 3] - inverse(self.poses.newest(sparse_map))[:3, 3]
        depth = float(np.median(transform_points(T_cam_world, points_world)[:, 2]))
        if self.state is SlamState.ROTATING and np.linalg.norm(way) > self.config.rotation.max_shift * depth:
            self.poses.forget(self._turned_frames)
        elif self.state is SlamState.ROTATING:
            for k, index in enumerate(self._turned_frames, start=1):
                self.poses.shift(index, k / (len(self._turned_frames) + 1) * way, sparse_map)
        self._turned_frames.clear()

    def note_directions(self) -> None:
        seen, pixels = self.tracker.seen()
        self._directions.note(seen.ids, pixels, self.poses.newest(self.mapper.map)[:3, :3], self.mapper.camera)

    # --- a camera that is lost ---------------------------------------------------------------------------------------

    def _find_camera(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world of a frame whose tracks broke: descriptors, then a search for the landmarks themselves; or LOST."""
        settings, sparse_map = self.config.relocalization, self.mapper.map
        self._num_lost = self._num_lost + 1 if self.state is SlamState.LOST else 0
        self.state = SlamState.LOST
        if not settings.enabled or not is_search_due(self._num_lost, settings):
            return None
        strictness = replace(
            self.config.localization,
            min_inliers=settings.min_inliers,
            min_inlier_ratio=settings.min_inlier_ratio,
            ransac_iterations=settings.ransac_iterations,
        )
        keyframes = self._remembered.to_try(self._num_lost)
        found = relocalize(front.frame, keyframes, sparse_map, self.mapper.camera, settings, strictness)
        if not found.converged:
            return None
        self.tracker.end_all()
        self.mapper.recover(front, found.T_cam_world, settings.gate_px)
        T_cam_world = self.refine(found.T_cam_world)
        self.mapper.recover(front, T_cam_world)
        seen, _ = self.tracker.seen()
        if sparse_map.mapped(seen.ids)[0].sum() < self.config.localization.min_inliers:
            return None
        self.state = SlamState.TRACKING
        return self.refine(T_cam_world)

    def lose(self) -> None:
        self.state = SlamState.LOST

    # --- keyframes in which the camera may be found again ------------------------------------------------------------

    def remember(self, keyframe: int, frame: Frame) -> None:
        self._remembered.add(keyframe, frame)

    def begin(self, keyframes: list[Frame]) -> None:
        self._directions = Directions(self.tracker.first_id)
        for keyframe, frame in enumerate(keyframes):
            self._remembered.add(keyframe, frame)

    def forget(self, kept_keyframes: Array, kept_ids: Array) -> None:
        self._remembered.move_to(kept_keyframes)
        self._directions.keep(kept_ids)
