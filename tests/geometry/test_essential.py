# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import PINHOLE, direction_error_deg, rotation_error_deg, two_views

from vitamin3d.geometry.essential import relative_pose
from vitamin3d.geometry.se3 import exp_se3

T_1_0 = exp_se3(np.array([-0.5, 0.1, 0.15, 0.03, 0.12, -0.05]))


def test_relative_pose_finds_rotation_and_direction(rng):
    points, pixels_0, pixels_1 = two_views(T_1_0, rng)
    view = relative_pose(pixels_0, pixels_1, PINHOLE, 1.0)
    assert rotation_error_deg(view.T_1_0, T_1_0) < 0.2
    assert direction_error_deg(view.T_1_0[:3, 3], T_1_0[:3, 3]) < 1.5
    assert np.linalg.norm(view.T_1_0[:3, 3]) == pytest.approx(1.0)
    good = np.isfinite(view.points_0[:, 0])
    assert good.mean() > 0.95
    scale = np.linalg.norm(T_1_0[:3, 3])
    assert np.median(np.linalg.norm(scale * view.points_0[good] - points[good], axis=1) / points[good, 2]) < 0.02


def test_relative_pose_throws_outliers_out(rng):
    _, pixels_0, pixels_1 = two_views(T_1_0, rng)
    pixels_1[:90] = rng.uniform(0, 480, (90, 2))
    view = relative_pose(pixels_0, pixels_1, PINHOLE, 1.0)
    assert rotation_error_deg(view.T_1_0, T_1_0) < 0.3
    assert direction_error_deg(view.T_1_0[:3, 3], T_1_0[:3, 3]) < 3.0
    assert view.is_inlier[:90].mean() < 0.15 and view.is_inlier[90:].mean() > 0.9
    assert np.isnan(view.points_0[~view.is_inlier]).all()


def test_relative_pose_is_the_same_twice(rng):
    _, pixels_0, pixels_1 = two_views(T_1_0, rng)
    a, b = (relative_pose(pixels_0, pixels_1, PINHOLE, 1.0) for _ in range(2))
    np.testing.assert_array_equal(a.T_1_0, b.T_1_0)
    np.testing.assert_array_equal(a.points_0, b.points_0)


def test_points_that_all_coincide_are_no_pose_or_have_no_parallax():
    same = np.full((20, 2), 100.0)
    view = relative_pose(same, same, PINHOLE, 1.0)
    assert view is None or not np.isfinite(view.points_0).any()
