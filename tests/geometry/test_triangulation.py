# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference
from scenes import PINHOLE, project

from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.geometry.triangulation import triangulate

T_B_A = exp_se3(np.array([-0.4, 0.05, 0.1, 0.02, 0.1, -0.03]))


def rays_of(points):
    rays_a = PINHOLE.rays_from_ideal(project(PINHOLE, np.eye(4), points))
    return rays_a, PINHOLE.rays_from_ideal(project(PINHOLE, T_B_A, points))


def test_exact_rays_give_the_points_back(rng):
    points = rng.uniform([-1, -1, 2], [1, 1, 6], (50, 3))
    found, parallax = triangulate(*rays_of(points), T_B_A)
    center_b = np.linalg.inv(T_B_A)[:3, 3]
    cosine = ((points - center_b) * points).sum(axis=1) / np.linalg.norm(points - center_b, axis=1) / np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(found, points, rtol=1e-10)
    np.testing.assert_allclose(parallax, np.degrees(np.arccos(cosine)), atol=1e-6)


def test_skew_rays_equal_the_twin_with_a_transform_each(rng):
    rays_a, rays_b = (np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), np.ones(30)]) for _ in range(2))
    transforms = np.array([exp_se3(xi) for xi in 0.4 * rng.standard_normal((30, 6))])
    found, parallax = triangulate(rays_a, rays_b, transforms)
    for i in range(30):
        point, angle = reference.triangulate(rays_a[i], rays_b[i], transforms[i])
        np.testing.assert_allclose(found[i], point, rtol=1e-7, atol=1e-9)
        assert abs(parallax[i] - angle) < 1e-6


def test_parallel_rays_are_nan_without_parallax():
    rays = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[0, 3] = -1.0
    points, parallax = triangulate(rays, rays, T)
    assert np.isnan(points).all()
    np.testing.assert_allclose(parallax, 0.0, atol=2e-6)


def test_rays_that_meet_behind_give_a_negative_depth():
    T = np.eye(4)
    T[0, 3] = -1.0  # b lies one to the right of a
    points, _ = triangulate(np.array([[0.0, 0, 1]]), np.array([[0.5, 0, 1]]), T)
    np.testing.assert_allclose(points, [[0, 0, -2]], atol=1e-12)


def test_nan_rays_stay_nan_and_harm_no_other():
    rays_a, rays_b = rays_of(np.array([[0.2, 0.1, 3.0], [0.1, 0.1, 4.0]]))
    rays_a[0] = np.nan
    points, _ = triangulate(rays_a, rays_b, T_B_A)
    assert np.isnan(points[0]).all()
    np.testing.assert_allclose(points[1], [0.1, 0.1, 4.0], rtol=1e-9)


def test_no_rays():
    points, parallax = triangulate(np.zeros((0, 3)), np.zeros((0, 3)), T_B_A)
    assert points.shape == (0, 3) and parallax.shape == (0,)
