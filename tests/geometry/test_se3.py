# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scipy.spatial.transform import Rotation

from vitamin3d.geometry import se3
from vitamin3d.geometry.se3 import between, exp_se3, inverse

ANGLES = [0.0, 1e-12, 1e-8, 9e-8, 1.1e-7, 9e-6, 1.1e-5, 1e-3, 0.5, 2.0, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]


def tangent(angle, seed=0):
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    return np.concatenate([rng.standard_normal(3), angle * axis / np.linalg.norm(axis)])


def test_skew_is_the_cross_product(rng):
    a, b = rng.standard_normal((2, 3))
    np.testing.assert_allclose(se3.skew(a) @ b, np.cross(a, b), rtol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_equals_the_matrix_exponential(angle):
    xi = tangent(angle)
    np.testing.assert_allclose(se3.exp_se3(xi), reference.exp_se3(xi), rtol=0, atol=1e-11)
    np.testing.assert_allclose(se3.exp_so3(xi[3:]), Rotation.from_rotvec(xi[3:]).as_matrix(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_undoes_the_exponential(angle):
    xi = tangent(angle)
    np.testing.assert_allclose(se3.log_se3(se3.exp_se3(xi)), xi, rtol=0, atol=1e-7 if angle > 3.14 else 1e-10)


def test_logarithm_at_pi_is_a_half_turn():
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        omega = se3.log_so3(R)
        np.testing.assert_allclose(np.linalg.norm(omega), np.pi, rtol=1e-12)
        np.testing.assert_allclose(se3.exp_so3(omega), R, atol=1e-12)


def test_quaternions_equal_scipy():
    rotations = Rotation.random(50, random_state=3)
    for rotation in rotations:
        q = se3.quaternion_xyzw(rotation.as_matrix())
        expected = rotation.as_quat()
        np.testing.assert_allclose(q, expected * np.sign(expected[3]), atol=1e-14)
        np.testing.assert_allclose(se3.rotation_from_quaternion(3 * q), rotation.as_matrix(), atol=1e-14)


def test_inverse_of_a_stack(rng):
    stack = np.array([se3.exp_se3(xi) for xi in rng.standard_normal((5, 6))])
    np.testing.assert_allclose(se3.inverse(stack), np.linalg.inv(stack), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(stack[2]), np.linalg.inv(stack[2]), atol=1e-13)
    assert se3.inverse(np.zeros((0, 4, 4))).shape == (0, 4, 4)


def test_transform_points_equals_homogeneous_coordinates(rng):
    T, points = se3.exp_se3(rng.standard_normal(6)), rng.standard_normal((7, 3))
    expected = (T @ np.column_stack([points, np.ones(7)]).T).T[:, :3]
    np.testing.assert_allclose(se3.transform_points(T, points), expected, atol=1e-14)


def test_between_two_cameras_the_centre_goes_straight_and_the_rotation_evenly(rng):
    T_0, T_1 = (exp_se3(rng.normal(size=6)) for _ in range(2))
    for share in (0.0, 0.3, 1.0):
        T = between(T_0, T_1, share)
        expected = (1 - share) * inverse(T_0)[:3, 3] + share * inverse(T_1)[:3, 3]
        np.testing.assert_allclose(inverse(T)[:3, 3], expected, atol=1e-12)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(between(T_0, T_1, 0.0), T_0, atol=1e-12)
    np.testing.assert_allclose(between(T_0, T_1, 1.0), T_1, atol=1e-9)
