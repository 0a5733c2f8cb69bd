# SPDX-License-Identifier: Apache-2.0
"""Track statistics on tracks whose lives and errors are known."""

import numpy as np
import pytest
import scenes

from vitamin3d.evaluation.track_statistics import (
    epipolar_distances,
    epipolar_inlier_ratio,
    live_tracks,
    pairs_at_age,
    poses_at,
    survival,
    track_lengths,
    track_statistics,
)
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Trajectory

FRAMES, POINTS = 8, 300


@pytest.fixture
def tracks(rng):
    """Every point in every frame of an arc, distorted pixels, rows shuffled: frame_index, track_id, pixels, T_world_cam."""
    camera, T_cam_world = scenes.EUROC, scenes.arc_poses(FRAMES)
    points = rng.uniform([-2.5, -2.0, 5.0], [2.5, 2.0, 7.0], (POINTS, 3))
    pixels = np.concatenate([camera.distort(scenes.project(camera, T, points)) for T in T_cam_world])
    frame_index, track_id = np.repeat(np.arange(FRAMES), POINTS), np.tile(np.arange(POINTS), FRAMES)
    order = rng.permutation(len(pixels))
    return frame_index[order], track_id[order], pixels[order], inverse(T_cam_world)


LIVES = {7: (10, 12, 14), 3: (10, 14), 9: (12,), 4: (14, 16)}
FRAME_INDEX = np.array([f for frames in LIVES.values() for f in frames])
TRACK_ID = np.array([i for i, frames in LIVES.items() for _ in frames])


def test_lives_by_hand():
    """A sequence read with stride two: ages count frames that were read."""
    assert live_tracks(FRAME_INDEX).tolist() == [2, 2, 3, 1]
    assert track_lengths(FRAME_INDEX, TRACK_ID).tolist() == [3, 2, 3, 1]  # tracks 3, 4, 7, 9
    one, two = pairs_at_age(FRAME_INDEX, TRACK_ID, 1), pairs_at_age(FRAME_INDEX, TRACK_ID, 2)
    seen = {(TRACK_ID[a], FRAME_INDEX[a], FRAME_INDEX[b]) for a, b in one}
    assert seen == {(7, 10, 12), (7, 12, 14), (4, 14, 16)}
    assert (TRACK_ID[one[:, 0]] == TRACK_ID[one[:, 1]]).all()
    assert survival(FRAME_INDEX, one, 1) == pytest.approx(3 / 7)
    assert survival(FRAME_INDEX, two, 2) == pytest.approx(2 / 4)  # 3 and 7, of the two in frame 10 and the two in frame 12
    assert np.isnan(survival(FRAME_INDEX, pairs_at_age(FRAME_INDEX, TRACK_ID, 4), 4))


def test_true_tracks_obey_the_epipolar_geometry(tracks):
    found = track_statistics(*tracks, scenes.EUROC)
    assert (found.live_median, found.live_minimum, found.num_tracks) == (POINTS, POINTS, POINTS)
    assert (found.length_median, found.length_p90) == (FRAMES, FRAMES)
    assert [a.age for a in found.ages] == [1, 5, 10, 20, 40]
    assert [(a.survival, a.epipolar_inlier_ratio) for a in found.ages[:2]] == [(1.0, 1.0)] * 2
    assert all(np.isnan([a.survival, a.epipolar_inlier_ratio]).all() for a in found.ages[2:])


def test_pixels_are_undistorted_first(tracks):
    frame_index, track_id, pixels, poses = tracks
    pairs = pairs_at_age(frame_index, track_id, 5)
    assert epipolar_inlier_ratio(frame_index, scenes.EUROC.undistort(pixels), pairs, poses, scenes.EUROC) == 1.0
    assert epipolar_inlier_ratio(frame_index, pixels, pairs, poses, scenes.EUROC) < 0.95


def test_wrong_tracks_are_counted(tracks):
    frame_index, track_id, pixels, poses = tracks
    wrong = (track_id < 60) & (frame_index >= 4)
    moved = pixels + np.where(wrong, 40.0, 0.0)[:, None] * [0.0, 1.0]  # the camera moves sideways: across the epipolar lines
    pairs = pairs_at_age(frame_index, track_id, 4)
    ratio = epipolar_inlier_ratio(frame_index, scenes.EUROC.undistort(moved), pairs, poses, scenes.EUROC)
    assert ratio == pytest.approx(1 - 60 / POINTS, abs=1e-12)


def test_frames_without_pose_and_without_baseline_are_left_out(tracks):
    frame_index, track_id, pixels, poses = tracks
    unknown = np.array(poses)
    unknown[0] = np.nan
    unknown[1] = unknown[2]
    bad = np.where(np.isin(frame_index, (0, 1))[:, None], 0.0, pixels)
    pairs = pairs_at_age(frame_index, track_id, 1)
    assert epipolar_inlier_ratio(frame_index, scenes.EUROC.undistort(bad), pairs, unknown, scenes.EUROC) == 1.0
    unknown[:] = np.nan
    assert np.isnan(epipolar_inlier_ratio(frame_index, pixels, pairs, unknown, scenes.EUROC))


def test_the_distance_is_in_pixels_and_the_same_from_both_sides(rng):
    camera, (T_0, T_1) = scenes.PINHOLE, scenes.arc_poses(4)[[0, 3]]
    points = rng.uniform([-1.0, -0.7, 5.0], [1.0, 0.7, 7.0], (50, 3))
    x_0, x_1 = scenes.project(camera, T_0, points), scenes.project(camera, T_1, points)
    T_1_0 = T_1 @ inverse(T_0)
    assert epipolar_distances(x_0, x_1, T_1_0, camera).max() < 1e-9
    lower = x_1 + np.array([0.0, 0.5])
    forth = epipolar_distances(x_0, lower, T_1_0, camera)
    np.testing.assert_allclose(forth, epipolar_distances(lower, x_0, inverse(T_1_0), camera), rtol=1e-9)
    np.testing.assert_allclose(forth, 0.5 / np.sqrt(2.0), rtol=0.1)  # half a pixel, shared by two pictures


def test_poses_are_found_by_time(rng):
    trajectory = Trajectory(np.array([0, 100, 200]), np.array([np.eye(4) * k for k in (1, 2, 3)]))
    poses = poses_at(np.array([1, 150, 199]), trajectory, 5)
    assert poses[:, 0, 0].tolist()[::2] == [1.0, 3.0] and np.isnan(poses[1]).all()


def test_no_tracks_at_all():
    none = np.zeros(0, np.int64)
    found = track_statistics(none, none, np.zeros((0, 2)), np.zeros((0, 4, 4)), scenes.EUROC)
    assert (found.live_median, found.num_tracks, found.length_p90) == (0.0, 0, 0.0)
    assert np.isnan([a.survival for a in found.ages]).all()
