# SPDX-License-Identifier: Apache-2.0
"""One map and what happens to it (Sec. 3): keyframes, landmarks, adjustments, calibration, and what it may forget."""

from dataclasses import replace

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement
from vitamin3d.mapping.keyframe_handover import KeyframeHandover
from vitamin3d.mapping.keyframe_selection import is_keyframe
from vitamin3d.mapping.keyframe_views import add_view
from vitamin3d.mapping.landmark_recovery import recover_landmarks, same_landmarks
from vitamin3d.mapping.landmark_triangulation import Rigidity, triangulate_landmarks
from vitamin3d.mapping.map_adjustment import MapAdjustment
from vitamin3d.mapping.map_condensation import Condensation, condense, condensed, is_due
from vitamin3d.mapping.motion_check import MotionCheck
from vitamin3d.mapping.readout_estimation import set_image_motion
from vitamin3d.sparse_map import SparseMap
from vitamin3d.steps import LandmarkTracker
from vitamin3d.types import Array, Frame, FrontEndFrame


class Mapper:
    """Owns a `SparseMap` and the camera that belongs to it.

    Args:
        tracker: its tracks become the map's landmarks, and end where the map contradicts them.
        adjustment: adjusts it.
    """

    def __init__(self, camera: Camera, tracker: LandmarkTracker, config: Config, adjustment: MapAdjustment) -> None:
        self.camera, self.tracker, self.config, self.adjustment = camera, tracker, config, adjustment
        self.times = adjustment.times
        self.map = SparseMap()
        self.rigidity = Rigidity()
        self.calibration = CalibrationRefinement(camera, config.calibration)
        self.handover = KeyframeHandover(config.window)
        self._motion_check = MotionCheck(config.motion_check)
        self._meetings: list[Array] = []
        self._num_born_before = tracker.num_born

    def inherit(self, other: "Mapper") -> None:
        """Begins with the camera as another map of the recording has refined it."""
        self._use(other.camera)
        self.calibration.inherit(other.calibration)

    def _use(self, camera: Camera) -> None:
        self.camera = camera
        self.tracker.use_camera(camera)

    def begin(self, first_map: SparseMap, keyframes: list[Frame]) -> None:
        """Takes the first map, and the pictures of its keyframes."""
        self.map = first_map
        self.handover.begin(keyframes)

    @property
    def wants_image_motion(self) -> bool:
        """Whether the image's motion is to be measured: the shutter rolls, or may be found to roll."""
        return bool(self.camera.readout_s) or self.calibration.wants_image_motion

    def note_image_motion(self, timestamp_ns: int, image_motion: Array) -> None:
        """How the image moved (6, 2) around a frame that is past: a keyframe just taken gets the mean of before and after."""
        if self.map.num_keyframes and self.map.timestamps_ns[-1] == timestamp_ns:
            set_image_motion(self.map, self.map.num_keyframes - 1, image_motion, self.camera)

    # --- landmarks ---------------------------------------------------------------------------------------------------

    def recover(self, front: FrontEndFrame, T_cam_world: Array, gate_px: float | None = None) -> int:
        """Takes up landmarks that came back into view; how many."""
        before, recovery = self.tracker.tracks.ids, self.config.recovery
        recovery = recovery if gate_px is None else replace(recovery, gate_px=gate_px)
        tracks, meetings = recover_landmarks(
            self.tracker.tracks, self.map, front.frame.image, front.kappa, self.tracker.image_motion, T_cam_world, self.camera, recovery,
            front.noise,
        )  # fmt: skip
        self.tracker.take_up(tracks)
        self._meetings.append(meetings)
        return int((~np.isin(tracks.ids, before)).sum())

    def merge_landmarks(self, T_cam_world: Array) -> None:
        """Landmarks that met tracked ones since the last keyframe and are the same become one, the older."""
        meetings = np.concatenate([*self._meetings, np.zeros((0, 2), np.int64)])
        pairs = same_landmarks(meetings, self.tracker.tracks, self.map, T_cam_world, self.config.recovery.merge_distance)
        self._meetings.clear()
        if len(pairs):
            self.map.merge_landmarks(self.map.rows_of(pairs[:, 0]), self.map.rows_of(pairs[:, 1]))
            self.tracker.take_up(self.tracker.tracks.renamed(pairs[:, 1], pairs[:, 0]))

    # --- keyframes ---------------------------------------------------------------------------------------------------

    def is_keyframe(self, frame: Frame) -> bool:
        """Whether the picture has moved, or lost its landmarks, enough since the last keyframe."""
        seen, pixels = self.tracker.seen()
        last = self.map.num_keyframes - 1
        rows, (is_mapped, landmarks) = self.map.observations_of(last), self.map.mapped(seen.ids)
        count = (self.map.is_mapped(self.map.obs_landmark[rows]) & self.map.obs_valid[rows]).sum()
        now, then = pixels[is_mapped], self.map.last_observation[landmarks]
        both = (then >= rows.start) & self.map.obs_valid[then]
        gap = frame.index - self.map.frame_indices[last]
        return is_keyframe(self.map.obs_pixels[then[both]], now[both], int(count), gap, self.config.keyframes)

    def add_keyframe(self, front: FrontEndFrame, T_cam_world: Array, position_deviation_deg: float) -> int:
        """A frame becomes a keyframe: landmarks from it, and every few of them the adjustment of the window; its number."""
        keyframe = add_view(self.map, self.tracker.view(front.frame), T_cam_world, position_deviation_deg)
        self.handover.add(keyframe, front.frame)
        triangulate_landmarks(self.map, self.camera, self.config.triangulation, self.rigidity)
        if keyframe % self.config.bundle_adjustment.keyframe_interval == 0:
            self.adjustment.begin_window(self.map, self.camera)
            self.take_adjustment()
        if self.calibration.is_due(self.map.num_keyframes):
            self.refine_calibration()
        return keyframe

    def refine_calibration(self) -> None:
        """The camera's parameters from all of the map (or as they were); the map moves along."""
        with self.times.timed("self_calibration"):
            self.take_adjustment(wait=True)  # it is of the camera before
            self._use(self.calibration.refine(self.map, self.camera))
            self.adjustment.forget_past()

    # --- bundle adjustment -------------------------------------------------------------------------------------------

    @property
    def is_adjusting(self) -> bool:
        """Whether the adjustment begun before has not entered the map yet."""
        return self.adjustment.adjuster.is_busy

    def await_adjustment(self, T_cam_world: Array) -> Array:
        """The adjustment begun before enters the map; T_cam_world (4, 4) of the newest frame as the last keyframe moved it."""
        self.adjustment.num_awaited += 1
        T_cam_keyframe = T_cam_world @ inverse(self.map.T_cam_world[-1])
        self.take_adjustment(wait=True)
        return np.asarray(T_cam_keyframe @ self.map.T_cam_world[-1])

    def take_adjustment(self, wait: bool = False) -> None:
        """The window that was adjusted meanwhile enters the map; its outliers leave the map and the tracks."""
        self.tracker.end(self.adjustment.take(self.map, self.camera, wait))

    def adjust_with_frame(self, T_cam_world: Array) -> Array:
        """The newest frame, which is no keyframe, adjusted with the newest keyframes; its T_cam_world (4, 4)."""
        seen, pixels = self.tracker.seen()
        return self.adjustment.with_frame(self.map, self.camera, T_cam_world, seen.ids, pixels)

    def finish(self) -> None:
        """The adjustment of the whole map at the end of a recording."""
        final = self.config.final_adjustment
        if not final.enabled or not 2 < self.map.num_keyframes <= final.max_keyframes:
            return
        if self.calibration.is_enabled:
            self.refine_calibration()
        self.adjustment.of_whole_map(self.map, self.camera)

    # --- what is sound, and what may be forgotten --------------------------------------------------------------------

    def is_bent(self) -> bool:
        """Whether the newest keyframes' own tracks tell another motion than the map's (`mapping/motion_check.py`)."""
        check, newest = self._motion_check, self.map.num_keyframes - 1
        return check.is_due(newest) and check.is_bent(self.map, self.camera)

    def last_sound_keyframe(self) -> int:
        """The map is sound up to there."""
        return self._motion_check.last_sound(self.map, self.camera)

    def condensed_when_due(self) -> Condensation | None:
        """Once in a while, what is left of the map without what it can do without."""
        new_rows = len(self.map.points_world) - len(self.map.remembered_ids)  # with gaps where other maps took ids
        new_tracks = max(new_rows, self.tracker.num_born - self._num_born_before)
        if self.map.num_keyframes == 0 or not is_due(self.map, new_tracks, self.config.memory):
            return None
        with self.times.timed("condense"):
            self.take_adjustment(wait=True)
            needed = np.concatenate([self.tracker.tracks.ids, *(pair.ravel() for pair in self._meetings)])
            return condense(self.map, np.unique(needed), self.handover.num_kept, self.config.memory)

    def cut_back(self, keyframe: int) -> Condensation:
        """What is left of the map without all that came after a keyframe; every track ends."""
        self.tracker.end_all()
        self._meetings = []
        kept = np.arange(keyframe + 1)
        return Condensation(condensed(self.map, kept, np.zeros(0, np.int64)), kept)

    def become(self, done: Condensation) -> None:
        """Takes a smaller map; keyframes are numbered anew."""
        self.handover.forget(done.kept_keyframes, self.map.num_keyframes)
        self._motion_check.move_to(done.kept_keyframes)
        self.adjustment.forget_past()
        self.map, self._num_born_before = done.map, self.tracker.num_born
