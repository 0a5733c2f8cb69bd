# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import PINHOLE, direction_error_deg, project, two_views

from vitamin3d.geometry.essential import relative_pose
from vitamin3d.geometry.p3p import p3p_ransac
from vitamin3d.geometry.se3 import exp_se3, log_so3

T_1_0 = exp_se3(np.array([-0.5, 0.1, 0.15, 0.03, 0.12, -0.05]))


def rotation_error_deg(a, b):
    return np.degrees(np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3])))


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


def test_p3p_finds_the_pose_among_outliers(rng):
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (200, 3))
    pixels = project(PINHOLE, T_1_0, points)
    pixels[:80] = rng.uniform(0, 480, (80, 2))
    T = p3p_ransac(points, pixels, PINHOLE, 4.0, 100)
    assert rotation_error_deg(T, T_1_0) < 1e-3
    np.testing.assert_allclose(T[:3, 3], T_1_0[:3, 3], atol=1e-4)


def test_p3p_needs_four_points(rng):
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (3, 3))
    assert p3p_ransac(points, project(PINHOLE, T_1_0, points), PINHOLE, 4.0, 100) is None


def test_p3p_of_garbage_is_none_or_finite(rng):
    for points in (np.zeros((30, 3)), rng.uniform(-1, 1, (30, 3))):
        T = p3p_ransac(points, rng.uniform(0, 400, (30, 2)), PINHOLE, 1.0, 20)
        assert T is None or np.isfinite(T).all()
