# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_poses, project, two_views

from vitamin3d.config import Config, InitializationConfig
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.geometry.se3 import exp_se3, inverse, log_so3
from vitamin3d.mapping.initialization_history import InitializationHistory, TrackedView, shared_tracks
from vitamin3d.mapping.map_initialization import build_first_map, sample_colors
from vitamin3d.mapping.two_view_initialization import initialize_from_two_views, median_motion
from vitamin3d.types import Frame, Tracks

CONFIG = InitializationConfig()
MOVING = exp_se3(np.array([-0.5, 0.05, 0.1, 0.01, 0.03, -0.02]))
TURNING = exp_se3(np.array([0.0, 0, 0, 0.02, 0.15, 0.03]))


def test_a_moving_camera_is_accepted(rng):
    attempt = initialize_from_two_views(*two_views(MOVING, rng)[1:], PINHOLE, CONFIG)
    assert attempt.reason == "" and not attempt.is_retry and 3.0 < attempt.parallax_deg < 10.0  # 0.5 units, seen from 3 to 8
    assert np.degrees(np.linalg.norm(log_so3(attempt.view.T_1_0[:3, :3].T @ MOVING[:3, :3]))) < 0.3
    direction = MOVING[:3, 3] / np.linalg.norm(MOVING[:3, 3])
    assert attempt.view.T_1_0[:3, 3] @ direction > np.cos(np.radians(3))
    assert np.isfinite(attempt.view.points_0[:, 0]).mean() > 0.9


def test_a_standing_camera_is_refused(rng):
    attempt = initialize_from_two_views(*two_views(np.eye(4), rng)[1:], PINHOLE, CONFIG)
    assert attempt.view is None and not attempt.is_retry
    assert attempt.reason.startswith("no parallax: the picture moved by 0.") and attempt.parallax_deg == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_turning_camera_is_refused(seed):
    pixels = two_views(TURNING, np.random.default_rng(seed))[1:]
    assert median_motion(*pixels) > 60
    attempt = initialize_from_two_views(*pixels, PINHOLE, CONFIG)
    assert attempt.view is None and not attempt.is_retry
    assert f"no parallax: {attempt.parallax_deg:.2f}° in" in attempt.reason and "turns but does not travel" in attempt.reason
    assert 0.0 < attempt.parallax_deg < 0.2


def test_too_few_tracks_are_refused(rng):
    attempt = initialize_from_two_views(*two_views(MOVING, rng, 99)[1:], PINHOLE, CONFIG)
    assert attempt.view is None and attempt.reason == "too few features: 99 tracks, 100 are needed"
    none = np.zeros((0, 2))
    assert initialize_from_two_views(none, none, PINHOLE, CONFIG).reason.startswith("too few features: 0 tracks")


def test_motion_that_is_not_rigid_is_refused(rng):
    pixels = rng.uniform(0, 480, (2, 300, 2))
    attempt = initialize_from_two_views(*pixels, PINHOLE, CONFIG)
    assert attempt.view is None and attempt.is_retry and "rigid" in attempt.reason


def test_median_motion():
    assert median_motion(np.zeros((3, 2)), np.array([[3.0, 4.0], [0, 1], [60, 80]])) == 5.0
    assert median_motion(np.zeros((0, 2)), np.zeros((0, 2))) == 0.0


# --- the frames before there is a map ----------------------------------------------------------------------------


def view_of(index, ids, pixels=None):
    n = len(ids)
    pixels = np.full((n, 2), float(index)) if pixels is None else pixels
    tracks = Tracks(np.array(ids), pixels, np.ones(n, np.float32), np.zeros(n, np.int32), np.zeros(n, np.int32))
    image = np.full((480, 640), index % 256, np.uint8)
    return TrackedView(Frame(index, 10**9 * index, image), tracks, pixels, NO_MOTION)


def test_shared_tracks_are_paired_by_id():
    rows_a, rows_b = shared_tracks(view_of(0, [5, 3, 8]), view_of(1, [8, 1, 5]))
    assert sorted(zip(rows_a.tolist(), rows_b.tolist(), strict=True)) == [(0, 2), (2, 0)]


def test_the_reference_stays_while_enough_tracks_live():
    history = InitializationHistory(dataclasses.replace(CONFIG, min_surviving_ratio=0.4))
    for k in range(13):
        history.append(view_of(k, range(k, 20 + k)))  # one of twenty dies per frame
    assert history.reference.frame.index == 0  # 8 of 20 live
    history.append(view_of(13, range(13, 33)))
    assert history.reference.frame.index == 3
    ids, pixels_0, pixels_1 = history.pair()
    np.testing.assert_array_equal(ids, np.arange(13, 23))
    assert (pixels_0 == 3).all() and (pixels_1 == 13).all()
    assert [view.frame.index for view in history.since_reference()] == list(range(3, 14))


def test_the_history_forgets_the_oldest():
    history = InitializationHistory(dataclasses.replace(CONFIG, history=4))
    for k in range(7):
        history.append(view_of(k, range(20)))
    assert [view.frame.index for view in history.views] == [3, 4, 5, 6]
    assert history.reference.frame.index == 3


def test_a_cut_leaves_the_newest_frame_as_reference():
    history = InitializationHistory(CONFIG)
    for k in range(5):
        history.append(view_of(k, range(20)))
    history.append(view_of(5, range(100, 120)))
    assert history.reference.frame.index == 5
    empty = InitializationHistory(CONFIG)
    empty.append(view_of(0, []))
    assert len(empty.pair()[0]) == 0


def test_after_a_failed_try_a_twentieth_more_motion_is_needed():
    history = InitializationHistory(dataclasses.replace(CONFIG, min_motion_px=20.0))
    zeros = np.zeros((5, 2))

    def worth(motion):
        return history.is_worth_a_try(zeros, zeros + np.array([motion, 0.0]))

    assert worth(5.0) and worth(6.0)  # too little for a real try
    assert worth(30.0)
    assert not worth(31.0) and not worth(31.4)
    assert worth(31.6)
    assert not worth(33.0)


# --- the first map -----------------------------------------------------------------------------------------------


def views_of_arc(rng, count=400, sigma_px=0.3):
    points = rng.uniform([-2.2, -1.6, 4.0], [2.2, 1.6, 8.0], (count, 3))
    poses = arc_poses(7)
    pixels = [project(PINHOLE, T, points) + sigma_px * rng.standard_normal((count, 2)) for T in poses]
    return points, poses, [view_of(k, np.arange(count), p) for k, p in enumerate(pixels)]


def test_the_first_map_is_the_truth_up_to_scale(rng):
    points, poses, views = views_of_arc(rng)
    attempt = initialize_from_two_views(views[0].ideal_pixels, views[-1].ideal_pixels, PINHOLE, CONFIG)
    first = build_first_map(attempt.view, np.arange(400), views, PINHOLE, Config())
    assert first is not None
    np.testing.assert_array_equal(first.map.T_cam_world[0], np.eye(4))
    assert 0.95 < np.nanmedian(first.map.points_world[:, 2]) < 1.05
    scale = np.median(points[:, 2]) / np.nanmedian(first.map.points_world[:, 2])
    error = np.linalg.norm(scale * first.map.points_world - points, axis=1) / points[:, 2]
    assert np.isfinite(error).mean() > 0.95 and np.nanmedian(error) < 0.01
    indices = [view.frame.index for view in first.keyframe_views]
    assert indices == first.map.frame_indices and indices[0] == 0 and indices[-1] == 6 and len(indices) > 3
    centers = scale * inverse(first.map.T_cam_world)[:, :3, 3]
    np.testing.assert_allclose(centers, inverse(poses[indices])[:, :3, 3], atol=0.04)


def test_a_wrong_pair_does_not_become_a_map(rng):
    _, _, views = views_of_arc(rng)
    attempt = initialize_from_two_views(views[0].ideal_pixels, views[-1].ideal_pixels, PINHOLE, CONFIG)
    wrong = dataclasses.replace(attempt.view, T_1_0=exp_se3(np.array([1.0, 0, 0, 0, 0, 0.5])))
    scrambled = [views[0], view_of(6, np.arange(400), rng.uniform(0, 480, (400, 2)))]
    assert build_first_map(wrong, np.arange(400), scrambled, PINHOLE, Config()) is None


def test_colors_come_from_the_nearest_pixel_inside():
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    color = np.stack([image, image + 100, image + 200], axis=-1)
    pixels = np.array([[1.4, 1.6], [-3.0, 0.0], [9.0, 9.0]])
    np.testing.assert_array_equal(sample_colors(Frame(0, 0, image), pixels), np.repeat([[9], [0], [11]], 3, axis=1))
    np.testing.assert_array_equal(sample_colors(Frame(0, 0, image, color), pixels), [[9, 109, 209], [0, 100, 200], [11, 111, 211]])
