# SPDX-License-Identifier: Apache-2.0
"""A queue that gives each of a sequence the ones before and after it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True)
class Around(Generic[Item]):
    """One of a sequence and those around it."""

    item: Item
    before: list[Item]
    """Earlier ones, the nearest first."""
    after: list[Item]
    """Later ones, the nearest first."""


class NeighbourQueue(Generic[Item]):
    """Lets items wait until those that come after them are there too; every `stride`-th comes out, with its neighbours."""

    def __init__(self, reach: int, stride: int) -> None:
        self._reach, self._stride = reach, stride
        self._items: list[Item] = []
        self._first, self._next = 0, 0

    def push(self, item: Item) -> list[Around[Item]]:
        """Adds one, in the order of time; those that are ready."""
        self._items.append(item)
        return self._taken(self._first + len(self._items) - self._reach)

    def expire(self, is_late: Callable[[Item], bool]) -> list[Around[Item]]:
        """Those that have waited too long, with the neighbours that are there."""
        end = self._next
        while end < self._first + len(self._items) and is_late(self._items[end - self._first]):
            end += self._stride
        return self._taken(end)

    def flush(self) -> list[Around[Item]]:
        """Those that still wait: none will follow."""
        return self._taken(self._first + len(self._items))

    def clear(self) -> None:
        """Drops those that wait."""
        self._first += len(self._items)
        self._next, self._items = max(self._next, self._first), []

    def _taken(self, end: int) -> list[Around[Item]]:
        ready = []
        while self._next < end:
            at = self._next - self._first
            before, after = self._items[max(0, at - self._reach) : at][::-1], self._items[at + 1 : at + 1 + self._reach]
            ready.append(Around(self._items[at], before, after))
            self._next += self._stride
            stale = min(max(0, self._next - self._reach - self._first), len(self._items))
            self._items, self._first = self._items[stale:], self._first + stale
        return ready
