# SPDX-License-Identifier: Apache-2.0
"""Keyframes that leave the window become a prior on those that stay (variable elimination), instead of anchors with fixed poses.

The landmarks that only they and older views see are eliminated with them; of those that are still tracked the leaving keyframe's
observations are dropped, so that nothing counts twice. The window then costs the same however long the map is.
"""

import numpy as np

from vitamin3d.bundle_adjustment.marginalization import CameraPrior, marginalize
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.rejection import with_observations
from vitamin3d.bundle_adjustment.variables import pinhole_model, squared_reprojection_errors
from vitamin3d.config import Config
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.mapping.window_selection import Window, build_problem
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array

ALIVE_KEYFRAMES = 3
"""Landmarks that the newest so many keyframes see are still tracked."""


class WindowPrior:
    """The window of the newest keyframes, and what those before it knew."""

    def __init__(self, config: Config) -> None:
        if config.window.past == "prior" and config.bundle_adjustment.keyframe_solver not in ("schur", "subspace-accelerated"):
            solver = config.bundle_adjustment.keyframe_solver
            raise InputError(
                f"window.past = 'prior' needs the bundle_adjustment.keyframe_solver 'subspace-accelerated' or 'schur', not {solver!r}"
            )
        self.size, self.config = config.window.keyframes, config.bundle_adjustment
        self.prior: CameraPrior | None = None
        self._oldest, self._num_held, self._is_used = -1, 0, np.zeros(0, np.bool_)

    def forget(self) -> None:
        """Begins anew: keyframes were numbered anew, or the camera is another one."""
        self.prior, self._oldest, self._is_used = None, -1, np.zeros(0, np.bool_)

    def advance(self, sparse_map: SparseMap, camera: Camera) -> tuple[Window, BundleProblem]:
        """The window of the newest keyframes and its problem; those that left it since the last call are in `prior`."""
        count, num_rows = sparse_map.num_keyframes, len(sparse_map.obs_landmark)
        self._is_used = np.append(self._is_used, np.zeros(num_rows - len(self._is_used), np.bool_))
        oldest = max(0, count - self.size)
        if self._oldest < 0:
            self._num_held = oldest + 2
        elif self._oldest < oldest:
            self._eliminate(sparse_map, self._window(self._oldest, count - 1), oldest - self._oldest, camera)
        self._oldest = oldest
        window = self._window(oldest, count)
        problem = build_problem(sparse_map, window)
        return window, with_observations(problem, ~self._is_used[problem.obs_rows])

    def _window(self, first: int, last: int) -> Window:
        """Keyframes first to last - 1; the two that were there at the beginning hold place and scale until they leave."""
        return Window(np.arange(first, last), last - first, int(np.clip(self._num_held - first, 0, last - first - 1)))

    def _eliminate(self, sparse_map: SparseMap, window: Window, num_gone: int, camera: Camera) -> None:
        """The first `num_gone` keyframes of the window as it was become a part of the prior."""
        problem = build_problem(sparse_map, window)
        problem = with_observations(problem, ~self._is_used[problem.obs_rows])
        by_gone = problem.obs_camera < num_gone
        is_alive = _points_of(problem, problem.obs_camera >= len(window.keyframes) - ALIVE_KEYFRAMES)
        is_outlier = squared_reprojection_errors(problem, camera) > self.config.outlier_px**2
        self._is_used[problem.obs_rows[by_gone]] = True
        part = with_observations(problem, ~(by_gone & is_alive[problem.obs_point]) & ~is_outlier)
        is_gone = _points_of(part, part.obs_camera < num_gone)
        self._is_used[part.obs_rows[is_gone[part.obs_point]]] = True
        gone = np.arange(len(window.keyframes)) < num_gone
        _, self.prior = marginalize(part, pinhole_model(camera), gone, self.config.sigma_px, self.prior)


def _points_of(problem: BundleProblem, rows: Array) -> Array:
    """(P,) bool: the points of the observations in a mask (M,)."""
    out = np.zeros(len(problem.points_world), np.bool_)
    out[problem.obs_point[rows]] = True
    return out
