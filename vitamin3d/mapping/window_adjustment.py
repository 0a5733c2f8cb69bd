# SPDX-License-Identifier: Apache-2.0
"""The adjustment of a window as a task that may be solved beside the tracking, and how its result enters a map that went on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.window_selection import Window, store_solution
from vitamin3d.sparse_map import SparseMap


@dataclass(frozen=True)
class WindowAdjustment:
    """A window, and its solution."""

    window: Window
    solved: BundleProblem


class Adjuster(Protocol):
    """Solves one task at a time."""

    @property
    def is_busy(self) -> bool:
        """A task was begun and its result is not taken yet."""

    def begin(self, task: Callable[[], WindowAdjustment]) -> None: ...

    def take(self, wait: bool = False) -> WindowAdjustment | None:
        """The result, once; None where there is none yet."""


class AdjustAtOnce:
    """Solves a task when it is begun."""

    def __init__(self) -> None:
        self._result: WindowAdjustment | None = None

    @property
    def is_busy(self) -> bool:
        return self._result is not None

    def begin(self, task: Callable[[], WindowAdjustment]) -> None:
        self._result = task()

    def take(self, wait: bool = False) -> WindowAdjustment | None:
        result, self._result = self._result, None
        return result


class SharedAdjuster:
    """The adjuster of all maps of a run: the windows are solved by one worker, which may be exchanged between two tasks."""

    def __init__(self) -> None:
        self._worker: Adjuster = AdjustAtOnce()

    def work_with(self, worker: Adjuster) -> None:
        """Windows are solved by this one from now on."""
        self._worker = worker

    @property
    def is_busy(self) -> bool:
        return self._worker.is_busy

    def begin(self, task: Callable[[], WindowAdjustment]) -> None:
        self._worker.begin(task)

    def take(self, wait: bool = False) -> WindowAdjustment | None:
        return self._worker.take(wait)


def store_adjustment(sparse_map: SparseMap, done: WindowAdjustment) -> None:
    """Writes a solution into the map; keyframes added since the window was chosen move along with its newest.

    Landmarks that left the map meanwhile stay away.
    """
    newest = int(done.window.keyframes[: done.window.num_adjusted].max())
    later = np.arange(newest + 1, sparse_map.num_keyframes)
    T_later_newest = sparse_map.T_cam_world[later] @ inverse(sparse_map.T_cam_world[newest])
    gone = done.solved.landmark_ids[~sparse_map.is_mapped(done.solved.landmark_ids)]
    store_solution(sparse_map, done.window, done.solved)
    sparse_map.points_world[gone] = np.nan
    sparse_map.T_cam_world[later] = T_later_newest @ sparse_map.T_cam_world[newest]
