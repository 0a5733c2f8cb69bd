# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import PINHOLE, project

from vitamin3d._jit import kernel
from vitamin3d.geometry import reprojection, robust
from vitamin3d.geometry.se3 import exp_se3

linearize, retract, squared_error = reprojection.linearize, reprojection.retract, reprojection.squared_error


@kernel
def run_linearize(intrinsics, R, t, X, pixel, r, J_pose, J_point):
    return linearize(intrinsics, R, t, X, pixel, r, J_pose, J_point)


@kernel
def run_retract(delta, R, t, R_new, t_new):
    retract(delta, R, t, R_new, t_new)


@kernel
def run_squared_error(intrinsics, R, t, X, pixel):
    return squared_error(intrinsics, R, t, X, pixel)


def parts(T):
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def linearized(T, X, pixel):
    r, J_pose, J_point = np.full(2, 7.0), np.full((2, 6), 7.0), np.full((2, 3), 7.0)
    filled = run_linearize(PINHOLE.intrinsics, *parts(T), X, pixel, r, J_pose, J_point)
    return filled, r, J_pose, J_point


def some_view(rng):
    T = exp_se3(0.3 * rng.standard_normal(6))
    X = np.linalg.inv(T)[:3] @ np.append(rng.uniform([-1, -1, 1], [1, 1, 5]), 1)
    return T, X, rng.uniform(0, 400, 2)


def test_residual_and_jacobians_equal_the_chain_rule(rng):
    for _ in range(20):
        T, X, pixel = some_view(rng)
        filled, r, J_pose, J_point = linearized(T, X, pixel)
        expected_pose, expected_point = reference.jacobians(PINHOLE.intrinsics, T, X)
        assert filled
        np.testing.assert_allclose(r, reference.residual(PINHOLE.intrinsics, T, X, pixel), atol=1e-10)
        np.testing.assert_allclose(J_pose, expected_pose, rtol=1e-10, atol=1e-8)
        np.testing.assert_allclose(J_point, expected_point, rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.9e-6])
def test_behind_the_camera_nothing_is_filled(z):
    filled, r, J_pose, J_point = linearized(np.eye(4), np.array([0.1, 0.2, z]), np.zeros(2))
    assert not filled
    assert (r == 7.0).all() and (J_pose == 7.0).all() and (J_point == 7.0).all()
    assert run_squared_error(PINHOLE.intrinsics, *parts(np.eye(4)), np.array([0.1, 0.2, z]), np.zeros(2)) == np.inf


def test_a_nan_point_gives_a_nan_error():
    error = run_squared_error(PINHOLE.intrinsics, *parts(np.eye(4)), np.array([np.nan, 0, 1]), np.zeros(2))
    assert np.isnan(error)


def test_reprojection_errors_equal_their_twin(rng):
    T = exp_se3(0.2 * rng.standard_normal(6))
    points = rng.uniform([-1, -1, -2], [1, 1, 5], (40, 3))
    pixels = rng.uniform(0, 400, (40, 2))
    twin = [reference.residual(PINHOLE.intrinsics, T, X, u) for X, u in zip(points, pixels, strict=True)]
    expected = [np.inf if r is None else np.linalg.norm(r) for r in twin]
    assert 5 < np.isinf(expected).sum() < 35
    np.testing.assert_allclose(reprojection.reprojection_errors(T, points, pixels, PINHOLE.intrinsics), expected, rtol=1e-12)
    assert reprojection.reprojection_errors(T, points[:0], pixels[:0], PINHOLE.intrinsics).shape == (0,)


def test_exact_projections_have_no_error(rng):
    T, points = exp_se3(0.1 * rng.standard_normal(6)), rng.uniform([-1, -1, 3], [1, 1, 5], (9, 3))
    errors = reprojection.reprojection_errors(T, points, project(PINHOLE, T, points), PINHOLE.intrinsics)
    np.testing.assert_allclose(errors, 0.0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.9e-5, 1.1e-5, 1e-3, 1.0, 3.1])
def test_retract_is_the_exponential_from_the_left(rng, size):
    delta = rng.standard_normal(6)
    delta[3:] *= size / np.linalg.norm(delta[3:])
    T = exp_se3(rng.standard_normal(6))
    R_new, t_new = np.empty((3, 3)), np.empty(3)
    run_retract(delta, *parts(T), R_new, t_new)
    expected = reference.exp_se3(delta) @ T
    np.testing.assert_allclose(R_new, expected[:3, :3], rtol=0, atol=1e-11)
    np.testing.assert_allclose(t_new, expected[:3, 3], rtol=0, atol=1e-11)


@pytest.mark.parametrize(("r", "sigma"), [(0.0, 1.0), (0.3, 1.0), (1.0, 1.0), (2.0, 0.7), (100.0, 2.0)])
def test_geman_mcclure_equals_its_twin(r, sigma):
    cost, weight = robust.geman_mcclure(r * r, 1.0 / sigma**2)
    assert cost == pytest.approx(reference.geman_mcclure(r, sigma), rel=1e-14)
    assert weight == pytest.approx(reference.geman_mcclure_weight(r, sigma), rel=1e-14)


def test_geman_mcclure_starts_as_the_square_and_saturates():
    assert robust.geman_mcclure(1e-6, 0.25)[0] == pytest.approx(1e-6, rel=1e-5)
    assert 3.99 < robust.geman_mcclure(1e6, 0.25)[0] < 4.0
    assert [robust.geman_mcclure(e, 0.25)[1] for e in (0.0, 4.0)] == pytest.approx([1.0, 0.25])
    assert robust.geman_mcclure(7.0, 0.0) == (7.0, 1.0)
