# SPDX-License-Identifier: Apache-2.0
"""The reprojection error and its derivatives: the one place that every solver takes them from (Eq. 6).

Residual r = projection(T_cam_world X) - u, pixels. The pose moves by `exp_se3([translation, rotation]) @ T_cam_world`.
"""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.camera import distort
from vitamin3d.types import Array

MIN_DEPTH = 1e-6


@inlined
def linearize(intrinsics, R, t, X, pixel, r, J_pose, J_point):  # type: ignore[no-untyped-def]
    """Fills r (2,), J_pose (2, 6), J_point (2, 3); False (nothing filled) for a point behind the camera."""
    x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
    y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    if z < MIN_DEPTH:
        return False
    inverse_z = 1.0 / z
    a, b = x * inverse_z, y * inverse_z
    fx, fy = intrinsics[0], intrinsics[1]
    r[0] = fx * a + intrinsics[2] - pixel[0]
    r[1] = fy * b + intrinsics[3] - pixel[1]
    gx, gy = fx * inverse_z, fy * inverse_z
    J_pose[0, 0], J_pose[0, 1], J_pose[0, 2] = gx, 0.0, -gx * a
    J_pose[0, 3], J_pose[0, 4], J_pose[0, 5] = -fx * a * b, fx * (1.0 + a * a), -fx * b
    J_pose[1, 0], J_pose[1, 1], J_pose[1, 2] = 0.0, gy, -gy * b
    J_pose[1, 3], J_pose[1, 4], J_pose[1, 5] = -fy * (1.0 + b * b), fy * a * b, fy * a
    for k in range(3):
        J_point[0, k] = gx * (R[0, k] - a * R[2, k])
        J_point[1, k] = gy * (R[1, k] - b * R[2, k])
    return True


@inlined
def linearize_distorted(model, R, t, X, pixel, r, J_pose, J_point, J_model):  # type: ignore[no-untyped-def]
    """Like `linearize` for a distorted pixel and the camera's `model` fx fy cx cy k1 k2 p1 p2; J_model (2, 8) is by these."""
    x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
    y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    if z < MIN_DEPTH:
        return False
    q = 1.0 / z
    a, b = x * q, y * q
    fx, fy, k1, k2, p1, p2 = model[0], model[1], model[4], model[5], model[6], model[7]
    a2, ab, b2 = a * a, a * b, b * b
    r2 = a2 + b2
    radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * k1 + 4.0 * k2 * r2
    u, v = a * radial + 2.0 * p1 * ab + p2 * (r2 + 2.0 * a2), b * radial + p1 * (r2 + 2.0 * b2) + 2.0 * p2 * ab
    r[0], r[1] = fx * u + model[2] - pixel[0], fy * v + model[3] - pixel[1]
    mixed = ab * slope + 2.0 * p1 * a + 2.0 * p2 * b
    ua, ub, va = fx * (radial + a2 * slope + 2.0 * p1 * b + 6.0 * p2 * a), fx * mixed, fy * mixed
    vb = fy * (radial + b2 * slope + 6.0 * p1 * b + 2.0 * p2 * a)
    J_pose[0, 0], J_pose[0, 1], J_pose[0, 2] = q * ua, q * ub, -q * (ua * a + ub * b)
    J_pose[0, 3], J_pose[0, 4], J_pose[0, 5] = -ua * ab - ub * (1.0 + b2), ua * (1.0 + a2) + ub * ab, ub * a - ua * b
    J_pose[1, 0], J_pose[1, 1], J_pose[1, 2] = q * va, q * vb, -q * (va * a + vb * b)
    J_pose[1, 3], J_pose[1, 4], J_pose[1, 5] = -va * ab - vb * (1.0 + b2), va * (1.0 + a2) + vb * ab, vb * a - va * b
    for m in range(2):
        for k in range(3):
            J_point[m, k] = J_pose[m, 0] * R[0, k] + J_pose[m, 1] * R[1, k] + J_pose[m, 2] * R[2, k]
    J_model[0, 0], J_model[0, 1], J_model[0, 2], J_model[0, 3] = u, 0.0, 1.0, 0.0
    J_model[1, 0], J_model[1, 1], J_model[1, 2], J_model[1, 3] = 0.0, v, 0.0, 1.0
    J_model[0, 4], J_model[0, 5], J_model[0, 6], J_model[0, 7] = fx * a * r2, fx * a * r2 * r2, 2.0 * fx * ab, fx * (r2 + 2.0 * a2)
    J_model[1, 4], J_model[1, 5], J_model[1, 6], J_model[1, 7] = fy * b * r2, fy * b * r2 * r2, fy * (r2 + 2.0 * b2), 2.0 * fy * ab
    return True


@inlined
def squared_error_distorted(model, R, t, X, pixel):  # type: ignore[no-untyped-def]
    """|r|² in pixels² of a distorted pixel, infinite behind the camera."""
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    if z < MIN_DEPTH:
        return np.inf
    q = 1.0 / z
    a = q * (R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0])
    b = q * (R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1])
    u, v = distort(a, b, model[4], model[5], model[6], model[7])
    du, dv = model[0] * u + model[2] - pixel[0], model[1] * v + model[3] - pixel[1]
    return du * du + dv * dv


@inlined
def squared_error(intrinsics, R, t, X, pixel):  # type: ignore[no-untyped-def]
    """|r|² in pixels², infinite behind the camera."""
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    if z < MIN_DEPTH:
        return np.inf
    x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
    y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
    du = intrinsics[0] * x / z + intrinsics[2] - pixel[0]
    dv = intrinsics[1] * y / z + intrinsics[3] - pixel[1]
    return du * du + dv * dv


@kernel
def _errors(intrinsics, R, t, points, pixels, out):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        out[i] = np.sqrt(squared_error(intrinsics, R, t, points[i], pixels[i]))


def reprojection_errors(T_cam_world: Array, points_world: Array, pixels: Array, intrinsics: Array) -> Array:
    """Distances (N,) in pixels between the projections of points (N, 3) and ideal pixels (N, 2); inf behind the camera."""
    out = np.empty(len(points_world))
    R, t = np.ascontiguousarray(T_cam_world[:3, :3]), np.ascontiguousarray(T_cam_world[:3, 3])
    _errors(intrinsics, R, t, np.ascontiguousarray(points_world), np.ascontiguousarray(pixels), out)
    return out


@inlined
def retract(delta, R, t, R_new, t_new):  # type: ignore[no-untyped-def]
    """exp_se3(delta) @ (R, t) into R_new (3, 3), t_new (3,); Rodrigues with series near zero."""
    w0, w1, w2 = delta[3], delta[4], delta[5]
    theta2 = w0 * w0 + w1 * w1 + w2 * w2
    if theta2 < 1e-10:
        a, b, c = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    else:
        theta = np.sqrt(theta2)
        a, b = np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta2
        c = (1.0 - a) / theta2
    e = np.empty((3, 3))
    e[0, 0], e[0, 1], e[0, 2] = 1.0 - b * (w1 * w1 + w2 * w2), b * w0 * w1 - a * w2, b * w0 * w2 + a * w1
    e[1, 0], e[1, 1], e[1, 2] = b * w0 * w1 + a * w2, 1.0 - b * (w0 * w0 + w2 * w2), b * w1 * w2 - a * w0
    e[2, 0], e[2, 1], e[2, 2] = b * w0 * w2 - a * w1, b * w1 * w2 + a * w0, 1.0 - b * (w0 * w0 + w1 * w1)
    d0, d1, d2 = delta[0], delta[1], delta[2]
    u0, u1, u2 = w1 * d2 - w2 * d1, w2 * d0 - w0 * d2, w0 * d1 - w1 * d0
    dot = w0 * d0 + w1 * d1 + w2 * d2
    v0 = d0 + b * u0 + c * (w0 * dot - theta2 * d0)
    v1 = d1 + b * u1 + c * (w1 * dot - theta2 * d1)
    v2 = d2 + b * u2 + c * (w2 * dot - theta2 * d2)
    for i in range(3):
        for j in range(3):
            R_new[i, j] = e[i, 0] * R[0, j] + e[i, 1] * R[1, j] + e[i, 2] * R[2, j]
    x, y, z = t[0], t[1], t[2]
    t_new[0] = e[0, 0] * x + e[0, 1] * y + e[0, 2] * z + v0
    t_new[1] = e[1, 0] * x + e[1, 1] * y + e[1, 2] * z + v1
    t_new[2] = e[2, 0] * x + e[2, 1] * y + e[2, 2] * z + v2
