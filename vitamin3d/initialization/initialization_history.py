# SPDX-License-Identifier: Apache-2.0
"""The tracked frames before there is a map: which of them the newest is paired with, and why it is not yet."""

from vitamin3d.config import InitializationConfig
from vitamin3d.initialization.two_view_initialization import median_motion
from vitamin3d.types import Array, TrackedView, shared_tracks


class InitializationHistory:
    """The last frames; the reference is the oldest that still shares enough tracks with the newest."""

    def __init__(self, config: InitializationConfig) -> None:
        self.config = config
        self.views: list[TrackedView] = []
        self._reference = 0
        self._tried_motion = 0.0

    @property
    def reference(self) -> TrackedView:
        return self.views[self._reference]

    @property
    def reference_index(self) -> int:
        """Of the reference's frame; -1 where there is none."""
        return self.reference.frame.index if self.views else -1

    def since_reference(self) -> list[TrackedView]:
        return self.views[self._reference :]

    def append(self, view: TrackedView) -> None:
        """Adds the newest frame; forgets the oldest, and moves the reference on when its tracks have died."""
        self.views.append(view)
        if len(self.views) > self.config.history:
            self.views.pop(0)
            self._reference = max(0, self._reference - 1)
        while self._reference < len(self.views) - 1 and self._surviving_ratio() < self.config.min_surviving_ratio:
            self._reference += max(1, (len(self.views) - 1 - self._reference) // 4)
            self._tried_motion = 0.0

    def _surviving_ratio(self) -> float:
        shared, _ = shared_tracks(self.reference, self.views[-1])
        return len(shared) / max(1, len(self.reference.tracks))

    def pair(self) -> tuple[Array, Array, Array]:
        """Ids (N,) and ideal pixels (N, 2) in the reference and (N, 2) in the newest frame of their shared tracks."""
        a, b = self.reference, self.views[-1]
        rows_a, rows_b = shared_tracks(a, b)
        return a.tracks.ids[rows_a], a.ideal_pixels[rows_a], b.ideal_pixels[rows_b]

    def is_worth_a_try(self, pixels_0: Array, pixels_1: Array) -> bool:
        """After a failed try, only with a twentieth more motion than then."""
        motion = median_motion(pixels_0, pixels_1)
        if self._tried_motion and motion < 1.05 * self._tried_motion:
            return False
        self._tried_motion = motion if motion >= self.config.min_motion_px else 0.0
        return True
