# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes import EUROC, PINHOLE

from vitamin3d._jit import kernel
from vitamin3d.geometry import reprojection, robust, se3
from vitamin3d.geometry.sim3_alignment import align_sim3

linearize, retract = reprojection.linearize, reprojection.retract


@kernel
def run_linearize(intrinsics, R, t, X, pixel, r, J_pose, J_point):
    return linearize(intrinsics, R, t, X, pixel, r, J_pose, J_point)


@kernel
def run_retract(delta, R, t, R_new, t_new):
    retract(delta, R, t, R_new, t_new)


@st.composite
def tangents(draw, largest=np.pi - 1e-4):
    """Any translation, any axis; angles that crowd near 0 and near pi."""
    direction = draw(arrays(float, 3, elements=st.floats(-1, 1)))
    norm = np.linalg.norm(direction)
    assume(norm > 0.1)
    small = st.floats(-12, 0).map(lambda x: min(10.0**x, largest))
    angle = draw(st.one_of(small, st.floats(0, largest), st.floats(0, 1e-3).map(lambda x: largest - x), st.just(0.0)))
    return np.concatenate([draw(arrays(float, 3, elements=st.floats(-10, 10))), angle * direction / norm])


def parts(T):
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def linearized(T, X):
    r, J_pose, J_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    assert run_linearize(PINHOLE.intrinsics, *parts(T), X, np.zeros(2), r, J_pose, J_point)
    return r, J_pose, J_point


def retracted(delta, T):
    T_new, R_new, t_new = np.eye(4), np.empty((3, 3)), np.empty(3)
    run_retract(delta, *parts(T), R_new, t_new)
    T_new[:3, :3], T_new[:3, 3] = R_new, t_new
    return T_new


@given(tangents(), tangents(), tangents())
def test_rigid_transforms_are_a_group(a, b, c):
    A, B, C = (se3.exp_se3(xi) for xi in (a, b, c))
    np.testing.assert_allclose(se3.inverse(A) @ A, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-11)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-11)
    np.testing.assert_allclose(A[:3, :3] @ A[:3, :3].T, np.eye(3), atol=1e-13)
    assert abs(np.linalg.det(A[:3, :3]) - 1) < 1e-13


@given(tangents())
def test_logarithm_and_exponential_undo_each_other(xi):
    T = se3.exp_se3(xi)
    np.testing.assert_allclose(se3.log_se3(T), xi, atol=1e-8)
    np.testing.assert_allclose(se3.exp_se3(se3.log_se3(T)), T, atol=1e-9)
    np.testing.assert_allclose(se3.exp_se3(-xi), se3.inverse(T), atol=1e-9)


@given(tangents(), st.floats(0, 1), st.floats(0, 1))
def test_a_line_through_the_identity_adds_up(xi, a, b):
    np.testing.assert_allclose(se3.exp_se3(a * xi) @ se3.exp_se3(b * xi), se3.exp_se3((a + b) * xi), atol=1e-9)


@given(tangents(np.pi))
def test_quaternions_come_back(xi):
    R = se3.exp_so3(xi[3:])
    q = se3.quaternion_xyzw(R)
    assert abs(np.linalg.norm(q) - 1) < 1e-12 and q[3] >= 0
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), R, atol=1e-12)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-2.5 * q), R, atol=1e-12)


@given(tangents(), tangents())
def test_retract_is_the_exponential_from_the_left(delta, xi):
    T = se3.exp_se3(xi)
    np.testing.assert_allclose(retracted(delta, T), se3.exp_se3(delta) @ T, atol=2e-10)


@given(st.floats(0, 751), st.floats(0, 479))
def test_pixels_go_to_ideal_and_back(u, v):
    pixel = np.array([[u, v]])
    ideal = EUROC.undistort(pixel)
    np.testing.assert_allclose(EUROC.distort(ideal), pixel, atol=1e-6)
    np.testing.assert_allclose(EUROC.undistort(EUROC.distort(ideal)), ideal, atol=1e-5)
    np.testing.assert_allclose(EUROC.ideal_from_points(3.7 * EUROC.rays_from_ideal(ideal)), ideal, atol=1e-9)


@given(st.floats(0.01, 50), st.floats(0.1, 20))
def test_the_weight_is_the_slope_over_twice_the_residual(r, sigma):
    h = 1e-5 * r
    (above, _), (below, _) = (robust.geman_mcclure(s * s, 1.0 / sigma**2) for s in (r + h, r - h))
    slope, weight = (above - below) / (2 * h), robust.geman_mcclure(r * r, 1.0 / sigma**2)[1]
    assert abs(slope / (2 * r) - weight) < 1e-6 * weight + 1e-9 * sigma**2 / (r * r)


@given(tangents(2.0), arrays(float, 3, elements=st.floats(-1, 1)), st.floats(1, 10))
def test_jacobians_are_finite_differences(xi, place, depth):
    T = se3.exp_se3(xi)
    X = se3.transform_points(se3.inverse(T), np.array([[place[0] * depth, place[1] * depth, depth]]))[0]
    _, J_pose, J_point = linearized(T, X)

    def difference(residual, h):
        """Fourth-order central difference."""
        return (8 * (residual(h) - residual(-h)) - (residual(2 * h) - residual(-2 * h))) / (12 * h)

    for k in range(6):
        numeric = difference(lambda h, k=k: linearized(retracted(h * np.eye(6)[k], T), X)[0], 1e-3)
        np.testing.assert_allclose(J_pose[:, k], numeric, rtol=0, atol=1e-6 * np.abs(J_pose).max())
    for k in range(3):
        numeric = difference(lambda h, k=k: linearized(T, X + h * np.eye(3)[k])[0], 1e-3)
        np.testing.assert_allclose(J_point[:, k], numeric, rtol=0, atol=1e-6 * np.abs(J_point).max())


@given(tangents(), st.floats(0.01, 100), st.integers(0, 2**32 - 1))
def test_a_similarity_is_recovered(xi, scale, seed):
    source, T = np.random.default_rng(seed).standard_normal((12, 3)), se3.exp_se3(xi)
    s, R, t = align_sim3(source, scale * source @ T[:3, :3].T + T[:3, 3])
    assert abs(s / scale - 1) < 1e-9
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-8 * max(1, 1 / scale))
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-8 * max(1, scale))
