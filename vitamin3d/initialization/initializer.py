# SPDX-License-Identifier: Apache-2.0
"""The frames before there is a map: tracked and kept until two of them make one (Sec. 5.1), or followed as a turn."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.initialization.initialization_history import InitializationHistory
from vitamin3d.initialization.map_initialization import build_first_map
from vitamin3d.initialization.two_view_initialization import initialize_from_two_views
from vitamin3d.localization.p3p_localization import localize
from vitamin3d.localization.rotation_tracking import Directions, Turns, rotation_of
from vitamin3d.sparse_map import SparseMap
from vitamin3d.steps import LandmarkTracker
from vitamin3d.types import Array, Frame, FrontEndFrame, SlamState, TrackedView


@dataclass(frozen=True)
class Beginning:
    """A map, and where the camera was before."""

    map: SparseMap
    keyframes: list[Frame]
    turned: list[tuple[Frame, Array]]
    """Frames in which the camera only turned, with T_cam_world (4, 4), the first keyframe's camera being the world."""
    placed: list[tuple[Frame, Array]]
    """Other frames, with T_cam_world (4, 4), by time."""


class Initializer:
    """Waits for two frames that make a map."""

    def __init__(self, tracker: LandmarkTracker, config: Config) -> None:
        self.tracker, self.config = tracker, config
        self.state = SlamState.INITIALIZING
        self.reason, self.num_retries = "no frame was read", 0
        """Why there is no map yet, and how often one seemed near."""
        self._history = InitializationHistory(config.initialization)
        self._directions, self._turns = Directions(tracker.first_id), Turns()
        self._aside: TrackedView | None = None

    def try_frame(self, front: FrontEndFrame, camera: Camera) -> Beginning | None:
        """The newest frame, of which the tracker knows already; the map that it makes with an earlier one."""
        view, aside = self.tracker.view(front.frame), self._aside
        self._aside = view if front.follows is None and self._history.views else None
        if self._aside is not None:
            return None  # of something else, for all that is known until the next frame
        if aside is not None and aside.frame.index == front.follows:
            self._history.append(aside)
        self._turn_on(front.frame, camera)
        self._history.append(view)
        return self._begun(camera)

    def try_views(self, views: Iterable[TrackedView], camera: Camera) -> Beginning | None:
        """The map that tracked frames make, the newest of them with an earlier one."""
        for view in views:
            self._history.append(view)
        return self._begun(camera)

    def _begun(self, camera: Camera) -> Beginning | None:
        """From the newest frame and the oldest that shares tracks with it, where they show parallax."""
        ids, pixels_0, pixels_1 = self._history.pair()
        if not self._history.is_worth_a_try(pixels_0, pixels_1):
            return None
        attempt = initialize_from_two_views(pixels_0, pixels_1, camera, self.config.initialization)
        self._turns.judge(attempt.parallax_deg, self._history.reference_index, self.config.rotation)
        views, first_id = self._history.since_reference(), self.tracker.first_id
        first = build_first_map(attempt.view, ids, views, camera, self.config, first_id) if attempt.view else None
        if first is None:
            self.reason = attempt.reason or "the first map did not survive its bundle adjustment"
            self.num_retries += attempt.is_retry or attempt.view is not None
            return None
        self.reason = ""
        turned = self._turns.since(first.map.frame_indices[0])
        placed = self._placed(first.map, camera)
        self._history.views.clear()
        self._directions, self._turns = Directions(first_id), Turns()
        return Beginning(first.map, [view.frame for view in first.keyframe_views], turned, placed)

    def _turn_on(self, frame: Frame, camera: Camera) -> None:
        """The rotation since the chain of frames began in which the camera did no more than turn."""
        seen, pixels = self.tracker.seen()
        turn = rotation_of(self._directions.of(seen.ids), pixels, seen.ages, self._turns.newest, camera, self.config.rotation)
        R = np.eye(3) if turn is None else turn.R_cam_world
        if turn is None or self._turns.ended_before(self._history.reference_index):
            self._turns, self._directions, R = Turns(), Directions(self.tracker.first_id), np.eye(3)
        self._turns.add(frame, R)
        self._directions.note(seen.ids, pixels, R, camera)
        has_turned = self._turns.has_turned(self.config.rotation)
        self.state = SlamState.ROTATING if has_turned else SlamState.INITIALIZING

    def _placed(self, first: SparseMap, camera: Camera) -> list[tuple[Frame, Array]]:
        """The frames from before the map localised against it, going back from it: their tracks were kept."""
        T_next, placed = first.T_cam_world[-1], []
        for view in reversed(self._history.views):
            T_cam_world = self._pose_of(view, first, T_next, camera)
            if T_cam_world is not None:
                T_next = T_cam_world
                placed.append((view.frame, T_cam_world))
            elif view.frame.index < first.frame_indices[0]:
                break  # what is farther back shares still less with the map
        return placed[::-1]

    def _pose_of(self, view: TrackedView, first: SparseMap, T_next: Array, camera: Camera) -> Array | None:
        """T_cam_world of a frame from before the map, None where it is not found; before the first keyframe it needs more landmarks."""
        if view.frame.index in first.frame_indices:
            return np.asarray(first.T_cam_world[first.frame_indices.index(view.frame.index)])
        localization, initialization = self.config.localization, self.config.initialization
        if view.frame.index < first.frame_indices[0]:
            localization = replace(localization, min_inliers=initialization.min_tracks, min_inlier_ratio=initialization.min_inlier_ratio)
        is_mapped, rows = first.mapped(view.tracks.ids)
        found = localize(first.points_world[rows], view.ideal_pixels[is_mapped], T_next, camera, localization, self.config.seed)
        return found.T_cam_world if found.converged else None
