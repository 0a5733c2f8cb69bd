# SPDX-License-Identifier: Apache-2.0
"""Keyframes wait until nothing moves them, then go once, with what the map knows of them."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, map_of, project, with_noise

from vitamin3d.config import Config, SnapshotConfig, WindowConfig
from vitamin3d.geometry.rolling_shutter import at_one_moment
from vitamin3d.mapping.keyframe_handover import KeyframeHandover, snapshot_of
from vitamin3d.mapping.landmark_statistics import information_by_row
from vitamin3d.types import Frame

CONFIG = dataclasses.replace(Config(), snapshot=SnapshotConfig(min_observations=1, max_reprojection_rms_px=9.0))


def frame(index, picture=None):
    return Frame(index, 50_000_000 * index, np.zeros((2, 3), np.uint8) if picture is None else picture)


def numbers(taken):
    return [keyframe for keyframe, _ in taken]


# --- when they go ----------------------------------------------------------------------------------------------------


def test_a_keyframe_goes_when_it_has_left_the_window():
    handover = KeyframeHandover(WindowConfig(keyframes=3))
    handover.begin([frame(0), frame(4)])
    assert handover.take_settled(2, 4) == []
    taken = []
    for keyframe in range(2, 7):
        handover.add(keyframe, frame(4 * keyframe))
        taken.append(numbers(handover.take_settled(keyframe + 1, 4 * keyframe)))
    assert taken == [[], [0], [1], [2], [3]]
    left = handover.take_settled(7, 24, everything=True)
    assert [(k, f.index) for k, f in left] == [(4, 16), (5, 20), (6, 24)]
    assert handover.take_settled(7, 99, everything=True) == []


def test_it_goes_sooner_where_fewer_newer_ones_are_wanted():
    handover = KeyframeHandover(WindowConfig(keyframes=9, settled_keyframes=2))
    handover.begin([frame(k) for k in range(5)])
    assert numbers(handover.take_settled(5, 4)) == [0, 1, 2]


def test_it_goes_where_the_camera_rests():
    handover = KeyframeHandover(WindowConfig(keyframes=9, settled_frames=10))
    handover.begin([frame(k) for k in (0, 5, 8)])
    assert [numbers(handover.take_settled(3, newest)) for newest in (9, 10, 14, 15, 30)] == [[], [0], [], [1], [2]]


@pytest.mark.parametrize("seed", range(8))
def test_each_goes_once_in_order_whenever_they_are_taken(seed):
    rng = np.random.default_rng(seed)
    handover = KeyframeHandover(WindowConfig(keyframes=int(rng.integers(1, 12)), settled_frames=int(rng.integers(0, 2) * 20)))
    taken, index = [], 0
    handover.begin([frame(0)])
    for keyframe in range(1, 60):
        index += int(rng.integers(1, 6))
        handover.add(keyframe, frame(index))
        if rng.random() < 0.4 or keyframe % 10 == 0:
            taken += handover.take_settled(keyframe + 1, index)
            assert numbers(taken) == list(range(len(taken)))
    taken += handover.take_settled(60, index, everything=True)
    assert numbers(taken) == list(range(60))
    assert (np.diff([f.index for _, f in taken]) > 0).all()


@pytest.mark.parametrize(("window", "most"), [(3, 16), (30, 60)])
def test_where_nobody_takes_them_the_oldest_are_given_up(window, most):
    handover = KeyframeHandover(WindowConfig(keyframes=window))
    assert handover.num_kept == most
    handover.begin([frame(0), frame(1)])
    for keyframe in range(2, 100):
        handover.add(keyframe, frame(keyframe))
    assert numbers(handover.take_settled(100, 99, everything=True)) == list(range(100 - most, 100))


def test_a_new_map_begins_with_its_own_keyframes():
    handover = KeyframeHandover(WindowConfig())
    handover.begin([frame(0), frame(1), frame(2)])
    handover.begin([frame(50), frame(60)])
    assert [(k, f.index) for k, f in handover.take_settled(2, 60, everything=True)] == [(0, 50), (1, 60)]


# --- keyframes numbered anew -----------------------------------------------------------------------------------------


def test_those_that_stay_are_numbered_anew():
    handover = KeyframeHandover(WindowConfig())
    handover.begin([frame(10 * k) for k in range(6)])
    handover.forget(np.array([0, 2, 5]), 6)
    handover.add(3, frame(60))
    assert [(k, f.index) for k, f in handover.take_settled(4, 60, everything=True)] == [(0, 0), (1, 20), (2, 50), (3, 60)]


def test_those_that_were_taken_stay_taken():
    handover = KeyframeHandover(WindowConfig(keyframes=3))
    handover.begin([frame(10 * k) for k in range(6)])
    assert numbers(handover.take_settled(6, 50)) == [0, 1, 2]
    handover.forget(np.array([0, 1, 3, 4, 5]), 6)
    assert [(k, f.index) for k, f in handover.take_settled(5, 50, everything=True)] == [(2, 30), (3, 40), (4, 50)]


def test_a_map_that_is_cut_back_keeps_its_first_keyframes():
    handover = KeyframeHandover(WindowConfig())
    handover.begin([frame(10 * k) for k in range(6)])
    handover.forget(np.arange(2), 6)
    assert [(k, f.index) for k, f in handover.take_settled(2, 99, everything=True)] == [(0, 0), (1, 10)]


# --- what is handed over ---------------------------------------------------------------------------------------------


def test_the_depths_are_those_of_the_map(scene, rng):
    sparse_map, keyframe = map_of(with_noise(scene, rng, 0.3, 0.0)[0]), 4
    seen = scene.obs_point[scene.obs_camera == keyframe]
    snapshot = snapshot_of(sparse_map, keyframe, frame(40), PINHOLE, CONFIG, 7, None)
    T, points = scene.T_cam_world[keyframe], scene.points[seen]
    np.testing.assert_allclose(snapshot.depths, points @ T[2, :3] + T[2, 3])
    np.testing.assert_allclose(snapshot.pixels, project(PINHOLE, T, points))
    np.testing.assert_array_equal(snapshot.T_cam_world, T)
    assert snapshot.map_number == 7 and snapshot.frame.index == 40
    assert (snapshot.relative_deviations > 0).all() and (snapshot.relative_deviations < 0.05).all()


def test_a_snapshot_stays_as_it_was_when_the_map_moves_on(scene):
    sparse_map = map_of(scene)
    snapshot = snapshot_of(sparse_map, 3, frame(30), PINHOLE, CONFIG, 0, None)
    before = snapshot.T_cam_world.copy(), snapshot.depths.copy(), snapshot.pixels.copy()
    sparse_map.T_cam_world[3, :3, 3] += 1.0
    sparse_map.points_world[:] *= 2.0
    for one, other in zip((snapshot.T_cam_world, snapshot.depths, snapshot.pixels), before, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_was_removed_or_is_no_landmark_is_no_vertex(scene):
    sparse_map = map_of(scene)
    rows = np.arange(*sparse_map.observations_of(4).indices(10**9))
    gone = sparse_map.obs_landmark[rows[[0, 5]]]
    sparse_map.remove_observations(rows[[0]])
    sparse_map.remove_landmarks(gone[1:])
    snapshot = snapshot_of(sparse_map, 4, frame(40), PINHOLE, CONFIG, 0, None)
    expected = np.delete(project(PINHOLE, scene.T_cam_world[4], scene.points[scene.obs_point[scene.obs_camera == 4]]), [0, 5], axis=0)
    np.testing.assert_allclose(snapshot.pixels, expected)


def test_what_is_known_of_the_whole_map_need_not_be_counted_again(scene, rng):
    sparse_map = map_of(with_noise(scene, rng, 0.5, 0.0)[0])
    by_row = information_by_row(sparse_map, PINHOLE)
    one, other = (snapshot_of(sparse_map, 2, frame(20), PINHOLE, CONFIG, 0, known) for known in (None, by_row))
    for name in ("pixels", "depths", "relative_deviations"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)


def test_the_picture_is_as_if_read_at_one_moment(scene, rng):
    picture = frame(40, rng.integers(0, 255, (PINHOLE.height, PINHOLE.width), np.uint8))
    sparse_map, rolling = map_of(scene), dataclasses.replace(PINHOLE, readout_s=0.03)
    assert snapshot_of(sparse_map, 4, picture, rolling, CONFIG, 0, None).frame is picture  # nothing moved
    sparse_map.image_motions[4, 0] = [300.0, 0.0]
    assert snapshot_of(sparse_map, 4, picture, PINHOLE, CONFIG, 0, None).frame is picture
    snapshot = snapshot_of(sparse_map, 4, picture, rolling, CONFIG, 0, None)
    np.testing.assert_array_equal(snapshot.frame.image, at_one_moment(picture, sparse_map.image_motions[4], rolling).image)
    assert (snapshot.frame.image != picture.image).mean() > 0.5
