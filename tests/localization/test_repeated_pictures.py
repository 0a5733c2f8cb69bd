# SPDX-License-Identifier: Apache-2.0
"""Pictures that repeat the one before lie on the way to where the camera is seen next."""

import weakref

import numpy as np
import pytest
from scenes import map_of

from vitamin3d.geometry.se3 import exp_se3, inverse, log_so3
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.localization.repeated_pictures import RepeatedPictures
from vitamin3d.types import Frame

SECOND = 10**9
STEP = exp_se3(np.array([0.3, -0.1, 0.2, 0.0, 0.3, 0.0]))


def frame(index, seconds, picture=None):
    return Frame(index, round(seconds * SECOND), np.zeros((2, 3), np.uint8) if picture is None else picture)


@pytest.fixture
def logged(scene):
    """A map, and a log that ends with frame 70 at second 7, at the last keyframe."""
    sparse_map, log = map_of(scene), PoseLog()
    log.add_world(frame(70, 7.0), scene.T_cam_world[7], sparse_map)
    return sparse_map, log, scene.T_cam_world[7]


def test_they_are_placed_by_their_time_on_the_way_to_the_next_picture(logged):
    sparse_map, log, before = logged
    repeats, now = RepeatedPictures(), STEP @ before
    for index, seconds in ((71, 7.1), (72, 7.5), (73, 7.6)):
        repeats.add(frame(index, seconds))
    repeats.place(8 * SECOND, now, log, sparse_map)
    centre, way = inverse(before)[:3, 3], inverse(now)[:3, 3] - inverse(before)[:3, 3]
    for index, share in ((71, 0.1), (72, 0.5), (73, 0.6)):
        T = log.pose(index, sparse_map)
        np.testing.assert_allclose(inverse(T)[:3, 3], centre + share * way, atol=1e-9)
        np.testing.assert_allclose(log_so3(T[:3, :3] @ before[:3, :3].T), [0.0, 0.3 * share, 0.0], atol=1e-9)
    assert log.trajectory(sparse_map).timestamps_ns.tolist() == [7 * SECOND, 7_100_000_000, 7_500_000_000, 7_600_000_000]


def test_the_next_picture_is_not_logged_by_them(logged):
    sparse_map, log, before = logged
    repeats = RepeatedPictures()
    repeats.add(frame(71, 7.5))
    repeats.place(8 * SECOND, before, log, sparse_map)
    assert len(log) == 2 and 71 in log


def test_each_is_placed_once(logged):
    sparse_map, log, before = logged
    repeats = RepeatedPictures()
    repeats.add(frame(71, 7.5))
    repeats.place(8 * SECOND, STEP @ before, log, sparse_map)
    placed = log.pose(71, sparse_map)
    repeats.place(9 * SECOND, STEP @ STEP @ before, log, sparse_map)
    repeats.finish(log, sparse_map)
    np.testing.assert_array_equal(log.pose(71, sparse_map), placed)
    assert len(log) == 2


def test_where_the_next_picture_tells_nothing_they_are_nowhere(logged):
    sparse_map, log, before = logged
    repeats = RepeatedPictures()
    repeats.add(frame(71, 7.5))
    repeats.place(8 * SECOND, None, log, sparse_map)
    repeats.place(9 * SECOND, STEP @ before, log, sparse_map)
    repeats.finish(log, sparse_map)
    assert 71 not in log and len(log) == 1


def test_at_the_end_of_a_recording_the_camera_rests(logged):
    sparse_map, log, before = logged
    repeats = RepeatedPictures()
    for index in (71, 72):
        repeats.add(frame(index, 0.1 * index))
    repeats.finish(log, sparse_map)
    for index in (71, 72):
        np.testing.assert_allclose(log.pose(index, sparse_map), before, atol=1e-12)


def test_where_none_repeats_nothing_happens(logged):
    sparse_map, log, before = logged
    repeats = RepeatedPictures()
    repeats.place(8 * SECOND, before, log, sparse_map)
    repeats.finish(log, sparse_map)
    assert len(log) == 1


def test_pictures_without_a_clock_are_placed_somewhere_on_the_way(logged):
    """All at one time."""
    sparse_map, log, before = logged
    repeats, now = RepeatedPictures(), STEP @ before
    repeats.add(frame(71, 7.0))
    repeats.place(7 * SECOND, now, log, sparse_map)
    centres = [inverse(T)[:3, 3] for T in (before, log.pose(71, sparse_map), now)]
    assert np.linalg.norm(centres[1] - centres[0]) <= np.linalg.norm(centres[2] - centres[0])


def test_pictures_that_wait_are_not_kept():
    repeats, picture = RepeatedPictures(), np.zeros((480, 640), np.uint8)
    kept = weakref.ref(picture)
    repeats.add(frame(71, 7.5, picture))
    del picture
    assert kept() is None
