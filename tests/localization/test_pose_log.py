# SPDX-License-Identifier: Apache-2.0
"""Poses of all frames."""

import numpy as np
from scenes import map_of

from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.types import Frame

NO_PICTURE = np.zeros((1, 1), np.uint8)


def logged(scene):
    """Keyframes 0, 10, 20 ... and, between them, frames 11 and 12."""
    sparse_map, log = map_of(scene), PoseLog()
    for k in range(8):
        log.add(Frame(10 * k, 10**9 * k, NO_PICTURE), k, np.eye(4))
    between = exp_se3(np.array([0.1, 0, 0, 0, 0.02, 0])) @ scene.T_cam_world[1]
    log.add_world(Frame(11, 11 * 10**8, NO_PICTURE), between, sparse_map)
    return sparse_map, log, between


def test_frames_move_with_their_keyframe(scene):
    sparse_map, log, between = logged(scene)
    np.testing.assert_allclose(log.pose(11, sparse_map), between, atol=1e-14)
    moved = exp_se3(np.array([0.5, 0.1, -0.2, 0.1, 0, 0]))
    sparse_map.T_cam_world[1] = sparse_map.T_cam_world[1] @ moved
    np.testing.assert_allclose(log.pose(11, sparse_map), between @ moved, atol=1e-14)
    np.testing.assert_allclose(log.pose(20, sparse_map), scene.T_cam_world[2], atol=1e-14)


def test_the_trajectory_is_camera_to_world_by_time(scene):
    sparse_map, log, between = logged(scene)
    trajectory = log.trajectory(sparse_map)
    assert len(log) == len(trajectory) == 9
    assert (np.diff(trajectory.timestamps_ns) > 0).all() and trajectory.timestamps_ns[2] == 11 * 10**8
    np.testing.assert_allclose(trajectory.T_world_cam[2], inverse(between), atol=1e-13)
    assert PoseLog().trajectory(sparse_map).T_world_cam.shape == (0, 4, 4)


def test_forgotten_frames_leave_no_trace_and_may_come_again(scene):
    sparse_map, log, between = logged(scene)
    np.testing.assert_array_equal(log.newest(sparse_map), log.pose(11, sparse_map))
    whole = log.trajectory(sparse_map)
    log.forget([70, 20])
    assert (70 in log, 20 in log, 11 in log, len(log)) == (False, False, True, 7)
    left = log.trajectory(sparse_map)
    np.testing.assert_array_equal(left.timestamps_ns, np.delete(whole.timestamps_ns, [3, 8]))
    np.testing.assert_array_equal(left.T_world_cam, np.delete(whole.T_world_cam, [3, 8], axis=0))
    log.add(Frame(20, 2 * 10**9, NO_PICTURE), 2, np.eye(4))
    log.add_world(Frame(75, 75 * 10**8, NO_PICTURE), between, sparse_map)
    assert 20 in log and len(log) == len(log.trajectory(sparse_map)) == 9
    np.testing.assert_allclose(log.newest(sparse_map), between, atol=1e-13)
    np.testing.assert_array_equal(np.delete(log.trajectory(sparse_map).T_world_cam, 8, axis=0), np.delete(whole.T_world_cam, 8, axis=0))
    log.forget([])
    assert len(log) == 9


def test_prediction_goes_on_as_before(scene):
    sparse_map, log = map_of(scene), PoseLog()
    step = exp_se3(np.array([0.1, 0, 0.05, 0, 0.02, 0.01]))
    log.add_world(Frame(30, 0, NO_PICTURE), scene.T_cam_world[3], sparse_map)
    np.testing.assert_allclose(log.predict(sparse_map), scene.T_cam_world[3], atol=1e-13)
    log.add_world(Frame(31, 1, NO_PICTURE), step @ scene.T_cam_world[3], sparse_map)
    np.testing.assert_allclose(log.predict(sparse_map), step @ step @ scene.T_cam_world[3], atol=1e-12)


def test_prediction_stands_still_after_a_gap(scene):
    sparse_map, log = map_of(scene), PoseLog()
    log.add_world(Frame(30, 0, NO_PICTURE), scene.T_cam_world[3], sparse_map)
    log.add_world(Frame(35, 1, NO_PICTURE), scene.T_cam_world[4], sparse_map)
    np.testing.assert_allclose(log.predict(sparse_map), scene.T_cam_world[4], atol=1e-13)
