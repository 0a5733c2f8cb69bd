# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import arc_scene, map_of

from vitamin3d.config import WindowConfig
from vitamin3d.mapping.window_selection import Window, build_problem, select_window, spread_over_map, store_solution


@pytest.fixture
def sparse_map():
    """Eight keyframes of forty landmarks; some observations removed, some landmarks without point, one restarted."""
    rng = np.random.default_rng(3)
    result = map_of(arc_scene(8, 40, rng))
    result.remove_observations(rng.choice(len(result.obs_landmark), 25, replace=False))
    result.points_world[[4, 9]] = np.nan
    result.remove_landmarks(np.array([7]))
    mine = result.obs_landmark[result.observations_of(7)]
    n = len(mine)
    result.add_keyframe(80, 8, np.eye(4), mine, np.zeros((n, 2)), np.zeros((n, 3), np.uint8), np.zeros((n, 81), np.uint8))
    result.points_world[7] = [0.1, 0.2, 5.0]
    return result


def twin(sparse_map, window):
    """(keyframe, landmark) -> row of all observations of landmarks that an adjusted keyframe sees."""
    seen = {}
    for id_ in np.flatnonzero(sparse_map.is_mapped(np.arange(len(sparse_map.points_world)))):
        rows = [(i, k) for i, k in reference.counting_observations(sparse_map, id_) if k in window.keyframes]
        if any(k in window.keyframes[: window.num_adjusted] for _, k in rows):
            seen |= {(k, int(id_)): i for i, k in rows}
    return seen


def rows_of(problem, window):
    keyframes = window.keyframes[np.minimum(problem.obs_camera, len(window.keyframes) - 1)]
    ids = problem.landmark_ids[problem.obs_point]
    return {(int(k), int(id_)): int(row) for k, id_, row in zip(keyframes, ids, problem.obs_rows, strict=True) if row >= 0}


@pytest.mark.parametrize(("keyframes", "adjusted"), [([5, 6, 7, 8], 4), ([6, 7, 8, 0, 2], 3), ([8, 1], 1), (list(range(9)), 9)])
def test_the_problem_holds_just_the_observations_that_count(sparse_map, keyframes, adjusted):
    window = Window(np.array(keyframes), adjusted, 1)
    problem = build_problem(sparse_map, window)
    expected = twin(sparse_map, window)
    assert rows_of(problem, window) == expected and len(expected) == len(problem.obs_rows) > 5
    np.testing.assert_array_equal(problem.obs_pixels, sparse_map.obs_pixels[problem.obs_rows])
    np.testing.assert_array_equal(problem.points_world, sparse_map.points_world[problem.landmark_ids])
    np.testing.assert_array_equal(problem.T_cam_world, sparse_map.T_cam_world[keyframes])
    np.testing.assert_array_equal(problem.camera_is_free, [1 <= k < adjusted for k in range(len(keyframes))])
    assert (np.diff(problem.obs_camera) >= 0).all()
    assert len(np.unique(problem.landmark_ids)) == len(problem.landmark_ids)


def test_observations_are_ordered_by_point_and_camera(sparse_map):
    problem = build_problem(sparse_map, Window(np.arange(9), 9, 1))
    assert problem.point_starts[0] == 0 and problem.point_starts[-1] == len(problem.obs_point)
    for p in range(len(problem.points_world)):
        rows = problem.point_order[problem.point_starts[p] : problem.point_starts[p + 1]]
        np.testing.assert_array_equal(rows, np.flatnonzero(problem.obs_point == p))
        assert (np.diff(problem.obs_camera[rows]) > 0).all()


def test_the_newest_frame_comes_last_and_free(sparse_map):
    window = Window(np.array([6, 7, 8]), 3, 2)
    view_ids, pixels = np.array([7, 0, 4, 39, 1]), np.arange(10.0).reshape(5, 2)
    T = 2 * np.eye(4)
    without, problem = build_problem(sparse_map, window), build_problem(sparse_map, window, (T, view_ids, pixels))
    known = np.isin(view_ids, without.landmark_ids)
    assert 0 < known.sum() < 5
    np.testing.assert_array_equal(problem.T_cam_world[-1], T)
    np.testing.assert_array_equal(problem.camera_is_free, [False, False, True, True])
    mine = problem.obs_camera == 3
    np.testing.assert_array_equal(problem.landmark_ids[problem.obs_point[mine]], view_ids[known])
    np.testing.assert_array_equal(problem.obs_pixels[mine], pixels[known])
    expected = {(k, id_): i for (k, id_), i in twin(sparse_map, window).items() if id_ in view_ids}
    assert (problem.obs_rows[mine] == -1).all() and rows_of(problem, window) == expected


def test_with_a_newest_frame_only_its_landmarks_take_part(sparse_map):
    window = Window(np.array([5, 6, 7, 8]), 3, 1)
    view = np.eye(4), np.array([0, 4, 39, 1, 12]), np.arange(10.0).reshape(5, 2)
    expected = {(k, id_): i for (k, id_), i in twin(sparse_map, window).items() if id_ in view[1]}
    problem = build_problem(sparse_map, window, view)
    assert rows_of(problem, window) == expected and len(expected) > 5
    assert set(problem.landmark_ids.tolist()) <= set(view[1].tolist()) - {4}


@pytest.mark.parametrize("most", [2, 4, 9, 100])
def test_keyframes_spread_over_the_map(sparse_map, most):
    window = spread_over_map(sparse_map, most)
    gaps = np.diff(window.keyframes)
    assert len(window.keyframes) == min(most, 9) == window.num_adjusted and window.num_fixed == 1
    assert window.keyframes[0] == 0 and window.keyframes[-1] == 8 and gaps.max() - gaps.min() <= 1


def test_an_empty_window_is_an_empty_problem(scene):
    sparse_map = map_of(scene, with_points=False)
    problem = build_problem(sparse_map, Window(np.array([6, 7]), 2, 1))
    assert len(problem.points_world) == len(problem.obs_rows) == 0 and problem.point_starts.tolist() == [0]


def test_the_solution_goes_back_to_the_adjusted_keyframes_only(sparse_map):
    window = Window(np.array([6, 7, 8, 0, 2]), 3, 0)
    problem = build_problem(sparse_map, window)
    before, points = sparse_map.T_cam_world.copy(), sparse_map.points_world.copy()
    problem.T_cam_world[:] += 1.0
    problem.points_world[:] += 1.0
    store_solution(sparse_map, window, problem)
    np.testing.assert_array_equal(sparse_map.T_cam_world[6:], before[6:] + 1)
    np.testing.assert_array_equal(sparse_map.T_cam_world[:6], before[:6])
    others = np.setdiff1d(np.arange(40), problem.landmark_ids)
    np.testing.assert_array_equal(sparse_map.points_world[problem.landmark_ids], points[problem.landmark_ids] + 1)
    np.testing.assert_array_equal(sparse_map.points_world[others], points[others])


def test_anchors_share_most_landmarks(sparse_map):
    window = select_window(sparse_map, WindowConfig(keyframes=3, anchors=2, min_shared_landmarks=1))
    seen = [{id_ for k, id_ in twin(sparse_map, Window(np.array([k]), 1, 0))} for k in range(9)]
    shared = [len(seen[k] & (seen[6] | seen[7] | seen[8])) for k in range(6)]
    best = sorted(sorted(range(6), key=lambda k: -shared[k])[:2])
    assert window.keyframes.tolist() == [6, 7, 8, *best]
    assert (window.num_adjusted, window.num_fixed) == (3, 0)


def test_anchors_with_too_little_in_common_are_not_taken(sparse_map):
    window = select_window(sparse_map, WindowConfig(keyframes=3, anchors=6, min_shared_landmarks=1000))
    assert window.keyframes.tolist() == [6, 7, 8]
    assert window.num_fixed == 2  # nothing else holds position, direction and scale


@pytest.mark.parametrize(
    ("count", "keyframes", "anchors", "adjusted", "fixed"),
    [(1, 12, 15, 1, 0), (2, 12, 15, 2, 1), (8, 12, 15, 8, 1), (8, 8, 15, 8, 1), (8, 3, 0, 3, 2), (8, 2, 0, 2, 1), (8, 1, 0, 1, 0)],
)
def test_the_gauge_is_held(count, keyframes, anchors, adjusted, fixed):
    sparse_map = map_of(arc_scene(count, 60, np.random.default_rng(0)))
    window = select_window(sparse_map, WindowConfig(keyframes=keyframes, anchors=anchors))
    assert (window.num_adjusted, window.num_fixed, len(window.keyframes)) == (adjusted, fixed, adjusted)
    assert window.keyframes[-1] == count - 1
