# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as (4, 4) float64 matrices, `X_a = T_a_b @ X_b`.

The tangent is (6,) `[translation, rotation]`, applied from the left: `exp_se3(xi) @ T`.
"""

import numpy as np

from vitamin3d.types import Array


def skew(v: Array) -> Array:
    """Cross-product matrix (3, 3) of a vector (3,): `skew(v) @ x == cross(v, x)`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp_so3(omega: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    theta = float(np.linalg.norm(omega))
    w = skew(omega)
    if theta < 1e-7:
        return np.eye(3) + w + 0.5 * w @ w
    a, b = np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta**2
    return np.asarray(np.eye(3) + a * w + b * w @ w)


def log_so3(rotation: Array) -> Array:
    """Rotation vector (3,) in radians, of norm at most pi, of a rotation matrix (3, 3)."""
    x, y, z, w = quaternion_xyzw(rotation)
    v = np.array([x, y, z])
    n = float(np.linalg.norm(v))
    if n < 1e-9:
        return np.asarray(2.0 * v / w)
    return np.asarray(2.0 * float(np.arctan2(n, w)) / n * v)


def exp_se3(xi: Array) -> Array:
    """Rigid transform (4, 4) of a tangent (6,) `[translation, rotation vector]`."""
    T = np.eye(4)
    omega = xi[3:]
    theta = float(np.linalg.norm(omega))
    w = skew(omega)
    T[:3, :3] = exp_so3(omega)
    if theta < 1e-5:
        V = np.eye(3) + 0.5 * w + w @ w / 6.0
    else:
        V = np.eye(3) + (1.0 - np.cos(theta)) / theta**2 * w + (theta - np.sin(theta)) / theta**3 * w @ w
    T[:3, 3] = V @ xi[:3]
    return T


def log_se3(T: Array) -> Array:
    """Tangent (6,) `[translation, rotation vector]` of a rigid transform (4, 4); inverse of `exp_se3`."""
    omega = log_so3(T[:3, :3])
    theta = float(np.linalg.norm(omega))
    w = skew(omega)
    if theta < 1e-5:
        V_inverse = np.eye(3) - 0.5 * w + w @ w / 12.0
    else:
        half = 0.5 * theta
        V_inverse = np.eye(3) - 0.5 * w + (1.0 - half / np.tan(half)) / theta**2 * w @ w
    return np.concatenate([V_inverse @ T[:3, 3], omega])


def inverse(T_a_b: Array) -> Array:
    """T_b_a of T_a_b; also for a stack (..., 4, 4)."""
    T_b_a = np.zeros_like(T_a_b)
    R_t = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = R_t
    T_b_a[..., :3, 3] = -(R_t @ T_a_b[..., :3, 3:])[..., 0]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def rotation_angle_deg(R: Array) -> float:
    """Of a rotation (3, 3), in [0, 180]."""
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0))))


def between(T_cam_world_0: Array, T_cam_world_1: Array, share: float) -> Array:
    """T_cam_world (4, 4) at a share of the way from one camera to another: the centre goes straight, the rotation evenly."""
    centre_0, centre_1 = (inverse(T)[:3, 3] for T in (T_cam_world_0, T_cam_world_1))
    T = np.eye(4)
    T[:3, :3] = exp_so3(share * log_so3(T_cam_world_1[:3, :3] @ T_cam_world_0[:3, :3].T)) @ T_cam_world_0[:3, :3]
    T[:3, 3] = -T[:3, :3] @ ((1.0 - share) * centre_0 + share * centre_1)
    return T


def transform_points(T_a_b: Array, points_b: Array) -> Array:
    """Points (N, 3) of frame b in frame a."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def quaternion_xyzw(rotation: Array) -> Array:
    """Unit quaternion (4,) `x y z w`, w >= 0, of a rotation matrix (3, 3) (Shepperd's choice of pivot)."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    i = int(np.argmax([m[0, 0], m[1, 1], m[2, 2], trace]))
    q = np.empty(4)
    if i == 3:
        q[:] = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 - trace + 2.0 * m[i, i]
        q[j] = m[j, i] + m[i, j]
        q[k] = m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def rotation_from_quaternion(xyzw: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) `x y z w`, normalised here."""
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
