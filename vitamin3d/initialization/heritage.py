# SPDX-License-Identifier: Apache-2.0
"""The newest tracked frames of a map: should the camera be lost in it, the map that follows begins with them."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import overload

from vitamin3d.types import TrackedView

MOST_BYTES = 1 << 28
"""Of the pictures."""


class Heritage(Sequence[TrackedView]):
    """Frames each of which continues the one before, the oldest first.

    Args:
        most: frames that are kept; fewer where the pictures are large.
    """

    def __init__(self, most: int) -> None:
        self._views: deque[TrackedView] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, index: int) -> TrackedView: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[TrackedView]: ...
    def __getitem__(self, index: int | slice) -> TrackedView | Sequence[TrackedView]:
        return self._views[index] if isinstance(index, int) else list(self._views)[index]

    def __iter__(self) -> Iterator[TrackedView]:
        return iter(self._views)

    def add(self, view: TrackedView, continues: bool) -> None:
        """The newest frame; where it `continues` none of those before, they are forgotten."""
        if not continues:
            self.clear()
        self._views.append(view)
        while len(self._views) * view.frame.num_bytes > MOST_BYTES:
            self._views.popleft()

    def clear(self) -> None:
        """No map will follow this one."""
        self._views.clear()
