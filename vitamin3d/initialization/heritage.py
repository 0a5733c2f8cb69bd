# SPDX-License-Identifier: Apache-2.0
"""The newest tracked frames of a map: should the camera be lost in it, the map that follows begins with them."""

from collections import deque

from vitamin3d.types import TrackedView

MOST_BYTES = 1 << 28
"""Of the pictures."""


class Heritage:
    """Frames each of which continues the one before.

    Args:
        most: frames that are kept; fewer where the pictures are large.
    """

    def __init__(self, most: int) -> None:
        self.views: deque[TrackedView] = deque(maxlen=most)
        """The oldest first."""

    def add(self, view: TrackedView, continues: bool) -> None:
        """The newest frame; where it `continues` none of those before, they are forgotten."""
        if not continues:
            self.views.clear()
        self.views.append(view)
        while len(self.views) * view.frame.num_bytes > MOST_BYTES:
            self.views.popleft()
