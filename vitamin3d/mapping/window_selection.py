# SPDX-License-Identifier: Apache-2.0
"""Which keyframes are adjusted, which older ones anchor them, and the problem that results.

A window that forgets the keyframes that made its landmarks drifts. So the older keyframes that share most landmarks
with it take part in every adjustment, their poses fixed.
"""

from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.bundle_adjustment.problem import BundleProblem, order_by_point
from vitamin3d.config import WindowConfig
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array


@kernel
def _mark_landmarks(rows, obs_landmark, obs_valid, first, points, marked):  # type: ignore[no-untyped-def]
    for i in range(rows[0], rows[1]):
        id_ = obs_landmark[i]
        if obs_valid[i] and i >= first[id_] and not np.isnan(points[id_, 0]):
            marked[id_] = True


@kernel
def _count_shared(starts, num_keyframes, obs_landmark, obs_valid, first, marked, shared):  # type: ignore[no-untyped-def]
    for k in range(num_keyframes):
        for i in range(starts[k], starts[k + 1]):
            if obs_valid[i] and marked[obs_landmark[i]] and i >= first[obs_landmark[i]]:
                shared[k] += 1


@kernel
def _gather(keyframes, num_window, starts, obs_landmark, obs_valid, first, points, local, ids, obs_rows, obs_cam, obs_point):  # type: ignore[no-untyped-def]
    """Numbers the window's landmarks and lists their observations; returns both counts.

    `local` comes as -1, and -2 for landmarks that do not take part.
    """
    num_points, num_obs = 0, 0
    for c in range(keyframes.shape[0]):
        k = keyframes[c]
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            if not obs_valid[i] or i < first[id_] or np.isnan(points[id_, 0]):
                continue
            if local[id_] < 0:
                if c >= num_window or local[id_] < -1:
                    continue
                local[id_] = num_points
                ids[num_points] = id_
                num_points += 1
            obs_rows[num_obs], obs_cam[num_obs], obs_point[num_obs] = i, c, local[id_]
            num_obs += 1
    return num_points, num_obs


@dataclass(frozen=True)
class Window:
    """The keyframes of one adjustment."""

    keyframes: Array
    """(C,) the adjusted ones, then the anchors."""
    num_adjusted: int
    num_fixed: int
    """So many of the first adjusted ones are held fixed too, where there are no anchors to hold the gauge."""


def select_window(sparse_map: SparseMap, config: WindowConfig) -> Window:
    """The newest keyframes, and the older ones that share most landmarks with them."""
    count = sparse_map.num_keyframes
    oldest = max(0, count - config.keyframes)
    recent = np.arange(oldest, count)
    anchors = _anchors(sparse_map, oldest, config) if oldest and config.anchors else np.zeros(0, np.int64)
    fixed = 0 if len(anchors) else min(2 if oldest else 1, len(recent) - 1)
    return Window(np.concatenate([recent, anchors]), len(recent), fixed)


def select_frame_window(sparse_map: SparseMap, adjusted: int, anchors: int) -> Window:
    """The window of an ordinary frame: the newest keyframes, anchored to so many just before them."""
    count = sparse_map.num_keyframes
    oldest, first = max(0, count - adjusted - anchors), max(0, count - adjusted)
    keyframes = np.concatenate([np.arange(first, count), np.arange(oldest, first)])
    return Window(keyframes, count - first, 0 if oldest < first else min(1, count - 1))


def whole_map(sparse_map: SparseMap) -> Window:
    """All keyframes, the first held fixed."""
    return Window(np.arange(sparse_map.num_keyframes), sparse_map.num_keyframes, 1)


def spread_over_map(sparse_map: SparseMap, most: int) -> Window:
    """At most so many keyframes, spread evenly, the first held fixed."""
    count = sparse_map.num_keyframes
    keyframes = np.linspace(0, count - 1, min(most, count)).astype(np.int64)
    return Window(keyframes, len(keyframes), 1)


def _anchors(sparse_map: SparseMap, oldest: int, config: WindowConfig) -> Array:
    starts = np.array(sparse_map.keyframe_starts)
    marked = np.zeros(len(sparse_map.points_world), np.bool_)
    rows = starts[[oldest, -1]]
    _mark_landmarks(rows, sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.first_observation, sparse_map.points_world, marked)
    shared = np.zeros(oldest, np.int64)
    _count_shared(starts, oldest, sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.first_observation, marked, shared)
    best = np.argsort(-shared, kind="stable")[: config.anchors]
    return np.sort(best[shared[best] >= config.min_shared_landmarks])


def build_problem(sparse_map: SparseMap, window: Window, view: tuple[Array, Array, Array] | None = None) -> BundleProblem:
    """The adjustment of a window, or of the newest frame, where it is no keyframe, and its landmarks.

    Args:
        view: T_cam_world (4, 4), landmark rows (N,) and ideal pixels (N, 2) of that frame, or None.
            Landmarks that it does not see are left out.
    """
    starts = np.array(sparse_map.keyframe_starts)
    size = int((starts[window.keyframes + 1] - starts[window.keyframes]).sum())
    local = np.full(len(sparse_map.points_world), -1 if view is None else -2, np.int32)
    if view is not None:
        local[view[1]] = -1
    ids, rows = np.empty(size, np.int64), np.empty(size, np.int64)
    obs_camera, obs_point = np.empty(size, np.int32), np.empty(size, np.int32)
    num_points, num_obs = _gather(
        window.keyframes, window.num_adjusted, starts, sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.first_observation,
        sparse_map.points_world, local, ids, rows, obs_camera, obs_point,
    )  # fmt: skip
    rows, obs_camera, obs_point, ids = rows[:num_obs], obs_camera[:num_obs], obs_point[:num_obs], ids[:num_points]
    poses, pixels = sparse_map.T_cam_world[window.keyframes], sparse_map.obs_pixels.take(rows, axis=0)
    is_free = np.arange(len(poses)) < window.num_adjusted
    is_free[: window.num_fixed] = False
    if view is not None:
        T_view, view_rows, view_pixels = view
        known = local[view_rows] >= 0
        obs_camera = np.append(obs_camera, np.full(known.sum(), len(poses), np.int32))
        obs_point = np.append(obs_point, local[view_rows[known]])
        rows = np.append(rows, np.full(known.sum(), -1))
        pixels = np.concatenate([pixels, view_pixels[known]])
        poses, is_free = np.concatenate([poses, T_view[None]]), np.append(is_free, True)
    point_starts, order = np.empty(num_points + 1, np.int64), np.empty(len(obs_point), np.int64)
    order_by_point(obs_point, num_points, point_starts, order)
    points = sparse_map.points_world[ids]
    return BundleProblem(poses, is_free, points, obs_camera, obs_point, pixels, point_starts, order, ids, rows)


def store_solution(sparse_map: SparseMap, window: Window, solved: BundleProblem) -> None:
    """Writes the adjusted poses and points back into the map."""
    adjusted = window.num_adjusted
    sparse_map.T_cam_world[window.keyframes[:adjusted]] = solved.T_cam_world[:adjusted]
    sparse_map.points_world[solved.landmark_ids] = solved.points_world
