# SPDX-License-Identifier: Apache-2.0
import numpy as np
from scenes import PINHOLE, project, rotation_error_deg

from vitamin3d.geometry.p3p import p3p_ransac
from vitamin3d.geometry.se3 import exp_se3

T_1_0 = exp_se3(np.array([-0.5, 0.1, 0.15, 0.03, 0.12, -0.05]))


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
