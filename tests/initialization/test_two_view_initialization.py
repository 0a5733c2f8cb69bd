# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import PINHOLE, two_views

from vitamin3d.config import InitializationConfig
from vitamin3d.geometry.se3 import exp_se3, log_so3
from vitamin3d.initialization.two_view_initialization import initialize_from_two_views, median_motion

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
