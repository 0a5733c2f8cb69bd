# SPDX-License-Identifier: Apache-2.0
"""From one map to the next, with tracks and maps that are told instead of filmed."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_poses, arc_scene, map_of, project, rotation_error_deg, view_of, with_noise

from vitamin3d.config import Config, MotionCheckConfig
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.slam import Slam
from vitamin3d.succession import leave, succeed
from vitamin3d.tracking.tracker import TrackIds
from vitamin3d.types import DominantFlow, Frame, FrontEndFrame, SlamState

UNCHECKED = dataclasses.replace(Config(), motion_check=MotionCheckConfig(enabled=False))
FIRST_ID = 700


def frame(index):
    return Frame(index, 10**9 * index, np.zeros((PINHOLE.height, PINHOLE.width), np.uint8))


# --- what the next map begins with -----------------------------------------------------------------------------------


@pytest.fixture
def film(rng):
    """Poses and views of seven frames of a travelling camera, frames 50 to 56, by tracks with ids from FIRST_ID."""
    points, poses = rng.uniform([-2.2, -1.6, 4.0], [2.2, 1.6, 8.0], (400, 3)), arc_poses(7)
    pixels = [project(PINHOLE, T, points) + 0.3 * rng.standard_normal((400, 2)) for T in poses]
    return poses, [view_of(50 + k, FIRST_ID + np.arange(400), p) for k, p in enumerate(pixels)]


def lost_after(views):
    """A map in which the camera was lost after these frames, and the next one, both of one run."""
    ids = TrackIds()
    ids.take(FIRST_ID)
    lost = Slam(PINHOLE, Config(), 0, ids=ids)
    ids.take(1000)
    for k, view in enumerate(views):
        lost.heritage.add(view, continues=k > 0)
    return lost, Slam(PINHOLE, Config(), 1, ids=ids)


def test_the_next_map_begins_at_once_with_the_tracks_of_the_one_before(film):
    poses, views = film
    lost, slam = lost_after(views)
    assert succeed(slam, lost) is SlamState.TRACKING is slam.state
    np.testing.assert_array_equal(slam.tracks.ids, views[-1].tracks.ids)
    np.testing.assert_array_equal(slam.tracks.pixels, views[-1].tracks.pixels)
    assert set(slam.map.ids_of(slam.map.landmarks)) <= set(views[-1].tracks.ids) and len(slam.map.landmarks) > 300
    assert slam.map.frame_indices[0] == 50 and slam.map.frame_indices[-1] == 56
    assert [index for index in range(100) if index in slam.poses] == list(range(50, 57))
    for k in range(7):
        assert rotation_error_deg(slam.poses.pose(50 + k, slam.map), poses[k]) < 0.3


def test_its_keyframes_will_be_handed_over_with_their_pictures(film):
    lost, slam = lost_after(film[1])
    succeed(slam, lost)
    taken = slam.take_settled_keyframes(everything=True)
    assert [kept.index for _, kept in taken] == slam.map.frame_indices and all(kept.image.any() for _, kept in taken)


def test_without_parallax_the_next_map_waits_with_the_tracks(film):
    lost, slam = lost_after([film[1][0]] * 2)
    assert succeed(slam, lost) is SlamState.INITIALIZING and slam.map.num_keyframes == 0 and slam.initializer.reason
    np.testing.assert_array_equal(slam.tracks.ids, FIRST_ID + np.arange(400))


def test_the_tracks_go_on_in_the_next_frame_and_new_ones_have_new_ids(film):
    _, views = film
    lost, slam = lost_after(views)
    succeed(slam, lost)
    kappa = np.zeros((PINHOLE.height, PINHOLE.width), np.float32)
    still = np.zeros((PINHOLE.height // 2, PINHOLE.width // 2, 2), np.float32)
    extrema = np.array([[5, 100], [5, 120]], np.int32)
    slam.process_frame(FrontEndFrame(frame(57), kappa, extrema, DominantFlow(np.eye(2), np.zeros(2), 0.0), still, 56))
    inside = ((views[-1].tracks.pixels > 2) & (views[-1].tracks.pixels < [637, 477])).all(axis=1)
    ids = set(slam.tracks.ids)
    assert len(ids & set(views[-1].tracks.ids[inside])) > 0.95 * inside.sum()  # coasting: there is nothing in the picture
    assert {FIRST_ID + 1000, FIRST_ID + 1001} <= ids


# --- what the one that is left keeps ---------------------------------------------------------------------------------


@pytest.fixture
def left(rng):
    """A map of ten keyframes, frames 0, 10, ..., with all frames up to 99 in its log."""
    scene = arc_scene(10, 300, rng)
    return filled(map_of(with_noise(scene, rng, 0.3, 0.01)[0]))


def filled(sparse_map, config=UNCHECKED):
    slam = Slam(PINHOLE, config)
    slam.mapper.begin(sparse_map, [frame(index) for index in sparse_map.frame_indices])
    slam.localizer.begin([frame(index) for index in sparse_map.frame_indices])
    for index in range(100):
        slam.poses.add_world(frame(index), np.eye(4), slam.map)
    slam.heritage.add(view_of(99, [1, 2]), continues=False)
    slam.tracker.take_up(view_of(99, [1, 2]).tracks)
    return slam


def successor_from(first):
    """A map that knows frames from this one on, but that was not first to be logged."""
    slam = Slam(PINHOLE, UNCHECKED, 1)
    sparse_map = map_of(arc_scene(2, 50, np.random.default_rng(2)))
    slam.mapper.begin(sparse_map, [])
    for index in (first + 3, first, first + 1):
        slam.poses.add_world(frame(index), np.eye(4), slam.map)
    return slam


def frames_of(slam):
    return [index for index in range(200) if index in slam.poses]


@pytest.mark.parametrize(("first", "keyframes"), [(45, 5), (40, 4), (41, 5), (99, 10), (500, 10), (1, 1)])
def test_nothing_of_the_map_that_is_left_lies_at_or_after_the_successors_first_frame(left, first, keyframes):
    centres = inverse(left.map.T_cam_world)[:keyframes, :3, 3]
    assert leave(left, successor_from(first))
    assert left.map.frame_indices == [10 * k for k in range(keyframes)]
    assert frames_of(left) == list(range(min(first, 100)))
    np.testing.assert_allclose(inverse(left.map.T_cam_world)[:, :3, 3], centres)
    assert [kept.index for _, kept in left.take_settled_keyframes(everything=True)] == left.map.frame_indices
    assert len(left.heritage.views) == len(left.tracks) == 0


def test_landmarks_stay_with_what_is_left_of_them(left):
    before = {
        int(id_): left.map.points_world[row] for id_, row in zip(left.map.ids_of(left.map.landmarks), left.map.landmarks, strict=True)
    }
    leave(left, successor_from(45))
    rows = left.map.landmarks
    assert len(rows) > 200 and left.map.num_observations[rows].max() <= 5
    for id_, row in zip(left.map.ids_of(rows), rows, strict=True):
        np.testing.assert_array_equal(left.map.points_world[row], before[int(id_)])


def test_of_a_map_that_the_successor_knows_from_its_first_frame_nothing_is_left(left):
    assert not leave(left, successor_from(0))
    assert len(left.heritage.views) == 0


def test_what_came_after_the_last_sound_keyframe_is_nobodys(rng):
    bend = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.radians(4.0), 0.0]))
    sparse_map = map_of(with_noise(arc_scene(10, 300, rng), rng, 0.3, 0.01)[0])
    for k in range(6, 10):
        sparse_map.T_cam_world[k] = sparse_map.T_cam_world[k] @ bend
    slam = filled(sparse_map, dataclasses.replace(Config(), motion_check=MotionCheckConfig(max_keyframes=6)))
    assert leave(slam, successor_from(95))
    assert slam.map.frame_indices == [0, 10, 20, 30, 40, 50] and frames_of(slam) == list(range(60))
