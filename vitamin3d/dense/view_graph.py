# SPDX-License-Identifier: Apache-2.0
"""Which views are neighbours of which: those before and after it in time; a view waits until they are there."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import takewhile
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True)
class Neighbourhood(Generic[Item]):
    """A view and its neighbours."""

    item: Item
    before: list[Item]
    """Earlier ones, the nearest first."""
    after: list[Item]
    """Later ones, the nearest first."""


class ViewGraph(Generic[Item]):
    """Lets views wait until those that come after them are there too; the wanted ones come out, with their neighbours.

    Args:
        reach: how many before and after one are its neighbours.
        is_wanted: asked about each item once, in the order of time; None: all are wanted.
    """

    def __init__(self, reach: int, is_wanted: Callable[[Item], bool] | None = None) -> None:
        self._reach, self._is_wanted = reach, is_wanted
        self._items: list[Item] = []
        self._wanted: list[int] = []
        self._first = 0

    def push(self, item: Item) -> list[Neighbourhood[Item]]:
        """Adds one, in the order of time; those that are ready."""
        if self._is_wanted is None or self._is_wanted(item):
            self._wanted.append(self._first + len(self._items))
        self._items.append(item)
        return self._taken(self._first + len(self._items) - self._reach)

    def expire(self, is_late: Callable[[Item], bool]) -> list[Neighbourhood[Item]]:
        """Those that have waited too long, with the neighbours that are there."""
        late = takewhile(lambda at: is_late(self._items[at - self._first]), self._wanted)
        return self._taken(1 + max(late, default=-1))

    def flush(self) -> list[Neighbourhood[Item]]:
        """Those that still wait: none will follow."""
        return self._taken(self._first + len(self._items))

    def clear(self) -> None:
        """Drops those that wait."""
        self._first += len(self._items)
        self._wanted, self._items = [], []

    def _taken(self, end: int) -> list[Neighbourhood[Item]]:
        """The wanted ones before the `end`-th, which leave; what is no neighbour of a later one is forgotten."""
        ready = [self._neighbourhood(at - self._first) for at in self._wanted if at < end]
        self._wanted = self._wanted[len(ready) :]
        next_one = self._wanted[0] if self._wanted else self._first + len(self._items)
        stale = max(0, next_one - self._reach - self._first)
        self._items, self._first = self._items[stale:], self._first + stale
        return ready

    def _neighbourhood(self, at: int) -> Neighbourhood[Item]:
        before, after = self._items[max(0, at - self._reach) : at], self._items[at + 1 : at + 1 + self._reach]
        return Neighbourhood(self._items[at], before[::-1], after)
