# SPDX-License-Identifier: Apache-2.0
"""What is adjusted: cameras, points and observations; and how to take a part of it."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.types import Array


@kernel
def order_by_point(obs_point, num_points, starts, order):  # type: ignore[no-untyped-def]
    """Counting sort: observations of point p are order[starts[p]:starts[p + 1]], cameras ascending."""
    starts[:] = 0
    for i in range(obs_point.shape[0]):
        starts[obs_point[i] + 1] += 1
    for p in range(num_points):
        starts[p + 1] += starts[p]
    cursor = starts.copy()
    for i in range(obs_point.shape[0]):
        p = obs_point[i]
        order[cursor[p]] = i
        cursor[p] += 1


@kernel
def _choose_evenly(candidates, point_starts, point_order, obs_camera, wanted, seen, chosen):  # type: ignore[no-untyped-def]
    """Takes candidates in turn while a camera that sees them has seen fewer than `wanted` chosen ones."""
    for p in candidates:
        rows = point_order[point_starts[p] : point_starts[p + 1]]
        for i in rows:
            if seen[obs_camera[i]] < wanted:
                chosen[p] = True
                break
        if chosen[p]:
            for i in rows:
                seen[obs_camera[i]] += 1


@dataclass(frozen=True)
class BundleProblem:
    """Cameras, points and observations of one adjustment (Eq. 6); observations sorted by camera."""

    T_cam_world: Array
    """(C, 4, 4)."""
    camera_is_free: Array
    """(C,) bool."""
    points_world: Array
    """(P, 3)."""
    obs_camera: Array
    """(M,) int32, ascending."""
    obs_point: Array
    """(M,) int32."""
    obs_pixels: Array
    """(M, 2) ideal pixels."""
    point_starts: Array
    """(P + 1,) int64: the observations of point p are point_order[point_starts[p]:point_starts[p + 1]]."""
    point_order: Array
    """(M,) int64."""
    landmark_ids: Array
    """(P,) int64, whose points these are: rows of the map, where they come from one."""
    obs_rows: Array
    """(M,) int64, index of the observation in the map; -1: of the frame that is no keyframe."""

    def renewed(self, made: "BundleProblem") -> "BundleProblem":
        """A problem `made` of this one's arrays, with this one's `landmark_ids` and `obs_rows`."""
        return dataclasses.replace(made, landmark_ids=self.landmark_ids, obs_rows=self.obs_rows[made.obs_rows])


def make_problem(
    T_cam_world: Array, points_world: Array, obs_camera: Array, obs_point: Array, obs_pixels: Array, camera_is_free: Array | None = None
) -> BundleProblem:
    """A problem from arrays in any order; all cameras but the first are free where camera_is_free (C,) does not say.

    `landmark_ids` and `obs_rows` number the points and observations as they are given.
    """
    C, P = len(T_cam_world), len(points_world)
    is_free = np.arange(C) > 0 if camera_is_free is None else np.asarray(camera_is_free, np.bool_)
    rows = np.argsort(obs_camera, kind="stable")
    camera, point = np.asarray(obs_camera, np.int32)[rows], np.asarray(obs_point, np.int32)[rows]
    starts, order = np.empty(P + 1, np.int64), np.empty(len(rows), np.int64)
    order_by_point(point, P, starts, order)
    poses, points, pixels = (np.array(a, np.float64) for a in (T_cam_world, points_world, np.asarray(obs_pixels)[rows]))
    return BundleProblem(poses, is_free, points, camera, point, pixels, starts, order, np.arange(P), rows)


def select_points(problem: BundleProblem, keep: Array) -> BundleProblem:
    """The problem with the points of a mask (P,) bool and their observations; all cameras."""
    rows = np.flatnonzero(keep[problem.obs_point])
    renumbered = (np.cumsum(keep) - 1).astype(np.int32)
    obs_point, num_points = renumbered[problem.obs_point[rows]], int(keep.sum())
    starts, order = np.empty(num_points + 1, np.int64), np.empty(len(rows), np.int64)
    order_by_point(obs_point, num_points, starts, order)
    return dataclasses.replace(
        problem,
        points_world=problem.points_world[keep],
        obs_camera=problem.obs_camera[rows],
        obs_point=obs_point,
        obs_pixels=problem.obs_pixels.take(rows, axis=0),
        point_starts=starts,
        point_order=order,
        landmark_ids=problem.landmark_ids[keep],
        obs_rows=problem.obs_rows[rows],
    )


def points_of_long_tracks(problem: BundleProblem, per_camera: int) -> Array:
    """(P,) bool: a subset of the points that are seen most often, about `per_camera` of them in each camera."""
    counts = np.diff(problem.point_starts)
    candidates = np.argsort(-counts, kind="stable")
    chosen, seen = np.zeros(len(counts), np.bool_), np.zeros(len(problem.T_cam_world), np.int64)
    candidates = candidates[counts[candidates] >= 2]
    _choose_evenly(candidates, problem.point_starts, problem.point_order, problem.obs_camera, per_camera, seen, chosen)
    return chosen
