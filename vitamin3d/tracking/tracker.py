# SPDX-License-Identifier: Apache-2.0
"""The live tracks of a sequence (Sec. 2): predict (Eq. 4), climb (Eq. 5), refill, end. It knows pictures, and no map."""

from collections.abc import Sequence

import numpy as np

from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rolling_shutter import NO_MOTION, fit_image_motion, ideal_pixels
from vitamin3d.image.extrema import refine_extrema, select_free_extrema
from vitamin3d.tracking.extrema_tracking import predict_by_dense_flow, predict_by_dominant_flow, track_extrema
from vitamin3d.types import Array, Frame, FrontEndFrame, TrackedView, Tracks


class TrackIds:
    """Numbers tracks at their birth, each number once in a run."""

    def __init__(self) -> None:
        self.next = 0

    def take(self, count: int) -> Array:
        """(count,) int64 new ids, ascending."""
        self.next += count
        return np.arange(self.next - count, self.next)


def with_ideal_pixels(tracks: Tracks, image_motion: Array, camera: Camera) -> tuple[Tracks, Array]:
    """The tracks that a camera's model can undistort, and their ideal pixels (N, 2)."""
    pixels = ideal_pixels(tracks.pixels, image_motion, camera)
    valid = np.isfinite(pixels[:, 0])
    return tracks.select(valid), pixels[valid]


class Tracker:
    """Follows the extrema of curvature from frame to frame; what its methods do is said by `LandmarkTracker`.

    Args:
        camera: whose ideal pixels `seen` has; `use_camera` changes it.
        ids: of the run; its own where it is alone.
    """

    def __init__(self, camera: Camera, config: Config, ids: TrackIds | None = None) -> None:
        self.camera, self.config = camera, config
        self.tracks = Tracks.empty()
        self.image_motion = NO_MOTION
        """(6, 2) of the newest frame (`geometry/rolling_shutter.py`)."""
        self.newest_frame = -1
        """Its index."""
        self.num_born = 0
        self.frame_count = 0
        self._ids = ids or TrackIds()
        self.first_id = self._ids.next
        """No track has a lesser id."""
        self._last_ns = 0
        self._before_break: tuple[int, Tracks, int] = -1, self.tracks, 0
        self._last_seen: tuple[tuple[Tracks, Array, Camera], tuple[Tracks, Array]] = (
            (self.tracks, self.image_motion, camera),
            (self.tracks, np.zeros((0, 2))),
        )

    def use_camera(self, camera: Camera) -> None:
        self.camera = camera

    def follow(self, front: FrontEndFrame, measures_motion: bool) -> tuple[int, Array] | None:
        """The tracks in the next frame: predicted from the one that it continues, and climbed.

        Args:
            measures_motion: how fast the image moves is measured, for the rolling shutter.

        Returns:
            Where it was measured: time stamp (ns) of the frame before, and its image motion (6, 2) as the mean of before and after it.
        """
        if front.follows != self.newest_frame and not self._resume(front):
            self.image_motion, self._last_ns = NO_MOTION, front.frame.timestamp_ns
            self.tracks = Tracks.empty()
            return None
        if front.dense_flow is not None:
            predicted = predict_by_dense_flow(self.tracks.pixels, front.dense_flow, self.config.extrema_tracking.flow_reduction)
        else:
            predicted = predict_by_dominant_flow(self.tracks.pixels, front.dominant_flow)
        before = self._measure_motion(front.frame.timestamp_ns, predicted) if measures_motion else None
        self.image_motion = self.image_motion if measures_motion else NO_MOTION
        self.tracks = self.climb(predicted, front)
        return before

    def climb(self, predicted: Array, front: FrontEndFrame) -> Tracks:
        """The tracks at the maxima near where they are predicted (N, 2)."""
        return track_extrema(self.tracks, predicted, front.kappa, self.config.extrema_tracking)

    def _resume(self, front: FrontEndFrame) -> bool:
        """Takes the tracks up again from before a break, if that is the frame followed; keeps those there are where none is."""
        followed, (index, tracks, last_ns) = front.follows, self._before_break
        if followed is not None and followed == index:
            self.tracks, self._last_ns = tracks, last_ns
            self._before_break = -1, Tracks.empty(), 0
            return True
        is_over = index < 0 or front.frame.index - index > self.config.continuity.max_gap
        if followed is None and len(self.tracks) and is_over:
            self._before_break = self.newest_frame, self.tracks, self._last_ns
        return False

    def _measure_motion(self, timestamp_ns: int, predicted: Array) -> tuple[int, Array]:
        motion = fit_image_motion(self.tracks.pixels, predicted, 1e-9 * (timestamp_ns - self._last_ns), self.camera)
        before = self._last_ns, 0.5 * (self.image_motion + motion)
        self.image_motion, self._last_ns = motion, timestamp_ns
        return before

    @property
    def is_refill_due(self) -> bool:
        return self.frame_count % self.config.extrema.refill_interval == 0

    def refill(self, front: FrontEndFrame) -> None:
        new = select_free_extrema(front.extrema, self.tracks.pixels, front.kappa.shape, self.config.extrema)
        ids, zeros = self._ids.take(len(new)), np.zeros(len(new), np.int32)
        self.num_born += len(new)
        kappa = front.kappa[new[:, 1], new[:, 0]]
        self.tracks = Tracks.concatenate(self.tracks, Tracks(ids, refine_extrema(front.kappa, new), kappa, zeros, zeros))

    def take_up(self, tracks: Tracks) -> None:
        self.tracks = tracks

    def end(self, ids: Array) -> None:
        if len(ids):
            self.tracks = self.tracks.select(~np.isin(self.tracks.ids, ids))

    def end_all(self) -> None:
        self.tracks = Tracks.empty()

    def end_frame(self, frame: Frame) -> None:
        self.frame_count += 1
        self.newest_frame = frame.index

    def pass_over(self, frame: Frame) -> None:
        self.newest_frame = frame.index

    def continue_from(self, views: Sequence[TrackedView]) -> None:
        newest = views[-1]
        self.newest_frame, self._last_ns = newest.frame.index, newest.frame.timestamp_ns
        self.first_id = min(int(view.tracks.ids.min(initial=self.first_id)) for view in views)
        self.tracks, self.image_motion = newest.tracks, newest.image_motion

    def seen(self) -> tuple[Tracks, Array]:
        at = self.tracks, self.image_motion, self.camera
        if not all(a is b for a, b in zip(at, self._last_seen[0], strict=True)):
            self._last_seen = at, self._compute_seen()
        return self._last_seen[1]

    def _compute_seen(self) -> tuple[Tracks, Array]:
        return with_ideal_pixels(self.tracks.select(self.tracks.missed == 0), self.image_motion, self.camera)

    def view(self, frame: Frame) -> TrackedView:
        return TrackedView(frame, *self.seen(), self.image_motion)
