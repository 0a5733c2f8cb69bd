# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a map that grows (Eq. 11–12): of the window at keyframes, of the newest frame, of the whole map at the end."""

import numpy as np

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.schur import adjust_accelerated
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.bundle_adjustment.variables import squared_reprojection_errors
from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.mapping.window_adjustment import Adjuster, WindowAdjustment, store_adjustment
from vitamin3d.mapping.window_prior import WindowPrior
from vitamin3d.mapping.window_selection import Window, build_problem, select_frame_window, select_window, store_solution, whole_map
from vitamin3d.sparse_map import SparseMap
from vitamin3d.steps import BundleSolver
from vitamin3d.types import Array, StepTimes

NONE = np.zeros(0, np.int64)


class MapAdjustment:
    """Adjusts one map; what it takes out of the map as outliers comes back as ids of tracks that had better end.

    Args:
        adjuster: runs the adjustments of windows, at once or beside the tracking.
        solve: adjusts a window.
    """

    def __init__(self, config: Config, adjuster: Adjuster, times: StepTimes, solve: BundleSolver = adjust_bundle) -> None:
        self.config, self.adjuster, self.times, self.solve = config, adjuster, times, solve
        self.num_awaited = 0
        """Keyframes that waited for the adjustment before."""
        self._past = WindowPrior(config)

    def begin_window(self, sparse_map: SparseMap, camera: Camera) -> None:
        """The adjustment of the newest keyframes and their landmarks, anchored."""
        if self.config.window.past == "prior":
            window, problem = self._past.advance(sparse_map, camera)
        else:
            window = select_window(sparse_map, self.config.window)
            problem = build_problem(sparse_map, window)
        prior = self._past.prior
        self.adjuster.begin(lambda: self._solved(window, problem, prior, camera))

    def _solved(self, window: Window, problem: BundleProblem, prior: CameraPrior | None, camera: Camera) -> WindowAdjustment:
        """Runs on the adjuster's thread."""
        with self.times.timed("bundle_adjustment_keyframe"):
            return WindowAdjustment(window, self.solve(problem, camera, self.config.bundle_adjustment, prior)[0])

    def take(self, sparse_map: SparseMap, camera: Camera, wait: bool = False) -> Array:
        """The window that was adjusted meanwhile enters the map; ids (N,) of the newest keyframe's tracks that are outliers."""
        done = self.adjuster.take(wait)
        if done is None:
            return NONE
        store_adjustment(sparse_map, done)
        return self._remove_outliers(sparse_map, done.window, done.solved, camera, self.config.bundle_adjustment.outlier_px)

    def _remove_outliers(self, sparse_map: SparseMap, window: Window, solved: BundleProblem, camera: Camera, limit_px: float) -> Array:
        is_outlier = squared_reprojection_errors(solved, camera) > limit_px**2
        is_newest = solved.obs_camera == window.num_adjusted - 1
        sparse_map.remove_observations(solved.obs_rows[is_outlier])
        return sparse_map.ids_of(solved.landmark_ids[solved.obs_point[is_outlier & is_newest]])

    def with_frame(self, sparse_map: SparseMap, camera: Camera, T_cam_world: Array, ids: Array, pixels: Array) -> Array:
        """A few sweeps over a frame that is no keyframe, the newest keyframes and the landmarks; the frame's T_cam_world (4, 4).

        Args:
            ids: (N,) of the tracks seen in the frame.
            pixels: (N, 2) ideal.
        """
        adjustment = self.config.bundle_adjustment
        if adjustment.sweeps_per_frame == 0:
            return T_cam_world
        with self.times.timed("bundle_adjustment_frame"):
            is_mapped, rows = sparse_map.mapped(ids)
            window = select_frame_window(sparse_map, adjustment.frame_keyframes, adjustment.frame_anchors)
            problem = build_problem(sparse_map, window, (T_cam_world, rows, pixels[is_mapped]))
            solved, _ = adjust_subspace(problem, camera, adjustment.sigma_px, adjustment.sweeps_per_frame)
            store_solution(sparse_map, window, solved)
        return np.asarray(solved.T_cam_world[-1])

    def of_whole_map(self, sparse_map: SparseMap, camera: Camera) -> None:
        """At the end of a recording."""
        final = self.config.final_adjustment
        with self.times.timed("final_adjustment"):
            everything = whole_map(sparse_map)
            problem = build_problem(sparse_map, everything)
            solved, _ = adjust_accelerated(problem, camera, final.sigma_px, final.iterations, final.relative_gain)
            store_solution(sparse_map, everything, solved)
            self._remove_outliers(sparse_map, everything, solved, camera, final.outlier_px)

    def forget_past(self) -> None:
        """Keyframes were numbered anew, or the camera is another one."""
        self._past.forget()
