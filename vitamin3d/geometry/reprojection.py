# SPDX-License-Identifier: Apache-2.0
"""The reprojection error and its derivatives: the one place that every solver takes them from (Eq. 6).

Residual r = projection(T_cam_world X) - u, pixels. The pose moves by `exp_se3([translation, rotation]) @ T_cam_world`.
"""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import gather, select, splat
from vitamin3d.geometry.cameras.pinhole import distort
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
def pose_of(R, t, c):  # type: ignore[no-untyped-def]
    """The twelve numbers of pose c: the rows of R (C, 3, 3), then t (C, 3)."""
    return (
        R[c, 0, 0], R[c, 0, 1], R[c, 0, 2], R[c, 1, 0], R[c, 1, 1], R[c, 1, 2], R[c, 2, 0], R[c, 2, 1], R[c, 2, 2],
        t[c, 0], t[c, 1], t[c, 2],
    )  # fmt: skip


@inlined
def poses_of(R, t, c):  # type: ignore[no-untyped-def]
    """`pose_of` for `Int64x8` c."""
    r, s = 9 * c, 3 * c
    return (
        gather(R, r), gather(R, r + 1), gather(R, r + 2), gather(R, r + 3), gather(R, r + 4), gather(R, r + 5),
        gather(R, r + 6), gather(R, r + 7), gather(R, r + 8), gather(t, s), gather(t, s + 1), gather(t, s + 2),
    )  # fmt: skip


@inlined
def model_of(models, m):  # type: ignore[no-untyped-def]
    """fx fy cx cy k1 k2 p1 p2 of model m of models (.., 8), each eight times."""
    return (
        splat(models[m, 0]), splat(models[m, 1]), splat(models[m, 2]), splat(models[m, 3]), splat(models[m, 4]), splat(models[m, 5]),
        splat(models[m, 6]), splat(models[m, 7]),
    )  # fmt: skip


@inlined
def models_of(models, c):  # type: ignore[no-untyped-def]
    """`model_of` for `Int64x8` c."""
    m = 8 * c
    return (
        gather(models, m), gather(models, m + 1), gather(models, m + 2), gather(models, m + 3), gather(models, m + 4),
        gather(models, m + 5), gather(models, m + 6), gather(models, m + 7),
    )  # fmt: skip


@inlined
def points_of(points, p):  # type: ignore[no-untyped-def]
    """x, y, z of points (.., 3) for `Int64x8` p; pixels (.., 2) are read likewise."""
    return gather(points, 3 * p), gather(points, 3 * p + 1), gather(points, 3 * p + 2)


@inlined
def in_camera(pose, X, Y, Z):  # type: ignore[no-untyped-def]
    """A point in the frame of a camera, its pose as `pose_of` gives it."""
    x = pose[0] * X + pose[1] * Y + pose[2] * Z + pose[9]
    y = pose[3] * X + pose[4] * Y + pose[5] * Z + pose[10]
    return x, y, pose[6] * X + pose[7] * Y + pose[8] * Z + pose[11]


@inlined
def linearize_simd(x, y, z, is_distorted, model, u, v):  # type: ignore[no-untyped-def]
    """The residual and its derivatives in few numbers, eight at a time: is_seen, q, a, b, r0, r1, p00, p01, p10, p11.

    (a, b, 1) / q is the point in the camera frame, q = a = b = 0 behind the camera; r the residual to the pixel (u, v),
    p the derivative of the pixel by (a, b). So the derivative by the pose is
    p @ [[q, 0, -q a, -a b, 1 + a², -b], [0, q, -q b, -(1 + b²), a b, a]], and by the point p @ q [[1, 0, -a], [0, 1, -b]] @ R.
    is_distorted says whether k1 to p2 of the model count.
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    is_seen = z >= MIN_DEPTH
    q = select(is_seen, 1.0 / z, 0.0)
    a, b = select(is_seen, x * q, 0.0), select(is_seen, y * q, 0.0)
    if not is_distorted:
        return is_seen, q, a, b, fx * a + cx - u, fy * b + cy - v, fx, splat(0.0), splat(0.0), fy
    xd, yd = distort(a, b, k1, k2, p1, p2)
    r2 = a * a + b * b
    radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * k1 + 4.0 * k2 * r2
    mixed = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    xa, yb = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a, radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
    return is_seen, q, a, b, fx * xd + cx - u, fy * yd + cy - v, fx * xa, fx * mixed, fy * mixed, fy * yb


@inlined
def squared_error_simd(x, y, z, is_distorted, model, u, v):  # type: ignore[no-untyped-def]
    """|r|² of `linearize_simd` in pixels², infinite behind the camera."""
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    q = 1.0 / z
    a, b = x * q, y * q
    if is_distorted:
        a, b = distort(a, b, k1, k2, p1, p2)
    du, dv = fx * a + cx - u, fy * b + cy - v
    return select(z >= MIN_DEPTH, du * du + dv * dv, np.inf)


@inlined
def model_derivatives(a, b, model):  # type: ignore[no-untyped-def]
    """The derivatives of the pixel at normalised coordinates (a, b): of u by fx k1 k2 p1 p2, of v by fy k1 k2 p1 p2."""
    fx, fy, _, _, k1, k2, p1, p2 = model
    u, v = distort(a, b, k1, k2, p1, p2)
    r2 = a * a + b * b
    r4, ab = r2 * r2, 2.0 * a * b
    return (
        u, fx * a * r2, fx * a * r4, fx * ab, fx * (r2 + 2.0 * a * a),
        v, fy * b * r2, fy * b * r4, fy * (r2 + 2.0 * b * b), fy * ab,
    )  # fmt: skip


@kernel
def fill_model_derivatives(models, rays, J):  # type: ignore[no-untyped-def]
    """J (N, 2, 8) by the model (1, 8) of the pixels of rays (N, 3) with z = 1."""
    for i in range(rays.shape[0]):
        d = model_derivatives(rays[i, 0], rays[i, 1], (
            models[0, 0], models[0, 1], models[0, 2], models[0, 3], models[0, 4], models[0, 5], models[0, 6], models[0, 7],
        ))  # fmt: skip
        J[i] = 0.0
        J[i, 0, 0], J[i, 0, 2], J[i, 0, 4], J[i, 0, 5], J[i, 0, 6], J[i, 0, 7] = d[0], 1.0, d[1], d[2], d[3], d[4]
        J[i, 1, 1], J[i, 1, 3], J[i, 1, 4], J[i, 1, 5], J[i, 1, 6], J[i, 1, 7] = d[5], 1.0, d[6], d[7], d[8], d[9]


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
    e00, e01, e02 = 1.0 - b * (w1 * w1 + w2 * w2), b * w0 * w1 - a * w2, b * w0 * w2 + a * w1
    e10, e11, e12 = b * w0 * w1 + a * w2, 1.0 - b * (w0 * w0 + w2 * w2), b * w1 * w2 - a * w0
    e20, e21, e22 = b * w0 * w2 - a * w1, b * w1 * w2 + a * w0, 1.0 - b * (w0 * w0 + w1 * w1)
    d0, d1, d2 = delta[0], delta[1], delta[2]
    u0, u1, u2 = w1 * d2 - w2 * d1, w2 * d0 - w0 * d2, w0 * d1 - w1 * d0
    dot = w0 * d0 + w1 * d1 + w2 * d2
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        R_new[0, j] = e00 * x + e01 * y + e02 * z
        R_new[1, j] = e10 * x + e11 * y + e12 * z
        R_new[2, j] = e20 * x + e21 * y + e22 * z
    x, y, z = t[0], t[1], t[2]
    t_new[0] = e00 * x + e01 * y + e02 * z + d0 + b * u0 + c * (w0 * dot - theta2 * d0)
    t_new[1] = e10 * x + e11 * y + e12 * z + d1 + b * u1 + c * (w1 * dot - theta2 * d1)
    t_new[2] = e20 * x + e21 * y + e22 * z + d2 + b * u2 + c * (w2 * dot - theta2 * d2)
