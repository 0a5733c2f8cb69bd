# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twins of the kernels of `vitamin3d.geometry`, `.tracking` and `.mapping`, from the equations."""

import itertools

import numpy as np
from scipy.linalg import expm
from scipy.optimize import root

# --- geometry ----------------------------------------------------------------------------------------------------


def distort(point, coefficients):
    """Brown–Conrady on a normalised point (2,)."""
    (x, y), (k1, k2, p1, p2) = point, coefficients
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    return np.array([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y])


def undistort(point, coefficients):
    """The root of the distortion that MINPACK finds from the distorted point."""
    found = root(lambda p: distort(p, coefficients) - point, point, tol=1e-13)
    return found.x if found.success else np.full(2, np.nan)


def exp_se3(xi):
    """The matrix exponential of the 4×4 twist."""
    (x, y, z), (a, b, c) = xi[:3], xi[3:]
    return expm(np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]], float))


def triangulate(ray_a, ray_b, T_b_a):
    """The middle between the two lines' nearest points, in frame a; and the angle in degrees."""
    d, t = T_b_a[:3, :3] @ ray_a, T_b_a[:3, 3]
    (a, b), *_ = np.linalg.lstsq(np.column_stack([d, -ray_b]), -t, rcond=None)
    middle = (a * d + t + b * ray_b) / 2
    angle = np.arctan2(np.linalg.norm(np.cross(d, ray_b)), d @ ray_b)
    return np.linalg.inv(T_b_a)[:3] @ np.append(middle, 1), np.degrees(angle)


def residual(intrinsics, T_cam_world, point, pixel):
    """Eq. 6; None behind the camera."""
    fx, fy, cx, cy = intrinsics
    x, y, z = (T_cam_world @ np.append(point, 1))[:3]
    return None if z < 1e-6 else np.array([fx * x / z + cx, fy * y / z + cy]) - pixel


def jacobians(intrinsics, T_cam_world, point):
    """Chain rule as matrices: d pixel / d X_cam times [I, -skew(X_cam)] and times R."""
    fx, fy = intrinsics[:2]
    x, y, z = (T_cam_world @ np.append(point, 1))[:3]
    d_pixel = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return d_pixel @ np.hstack([np.eye(3), -skew]), d_pixel @ T_cam_world[:3, :3]


def geman_mcclure(r, sigma):
    return sigma**2 * r**2 / (r**2 + sigma**2)


def geman_mcclure_weight(r, sigma):
    return (sigma**2 / (r**2 + sigma**2)) ** 2


# --- tracking ----------------------------------------------------------------------------------------------------


def curvature(f):
    """Eq. 1 pixel by pixel."""
    f, kappa = np.asarray(f, np.float64), np.zeros(f.shape)
    for v, u in itertools.product(range(1, f.shape[0] - 1), range(1, f.shape[1] - 1)):
        fx, fy = (f[v, u + 1] - f[v, u - 1]) / 2, (f[v + 1, u] - f[v - 1, u]) / 2
        fxx, fyy = f[v, u + 1] + f[v, u - 1] - 2 * f[v, u], f[v + 1, u] + f[v - 1, u] - 2 * f[v, u]
        fxy = (f[v + 1, u + 1] - f[v + 1, u - 1] - f[v - 1, u + 1] + f[v - 1, u - 1]) / 4
        kappa[v, u] = fy**2 * fxx - 2 * fx * fy * fxy + fx**2 * fyy
    return kappa


def local_maxima(kappa, floor, border):
    """The set of (u, v) above the floor that beat all eight neighbours; of equals, the first in reading order."""
    height, width = kappa.shape
    found = set()
    for v, u in itertools.product(range(border, height - border), range(border, width - border)):
        others = [(n, m) for n in (v - 1, v, v + 1) for m in (u - 1, u, u + 1) if (n, m) != (v, u)]
        rivals = [(kappa[n, m], (-n, -m)) for n, m in others if not np.isnan(kappa[n, m])]
        if kappa[v, u] > floor and all((kappa[v, u], (-v, -u)) > rival for rival in rivals):
            found.add((u, v))
    return found


def roundness(kappa, u, v):
    """4 det / trace² of the matrix of second derivatives, from the nine samples."""
    window = np.asarray(kappa, float)[v - 1 : v + 2, u - 1 : u + 2]
    second, cross = np.array([1.0, -2.0, 1.0]), np.array([-0.5, 0.0, 0.5])
    hessian = np.array([[window[1] @ second, cross @ window @ cross], [cross @ window @ cross, window[:, 1] @ second]])
    return 4 * np.linalg.det(hessian) / np.trace(hessian) ** 2


def parabola_maximum(below, center, above):
    """Of the parabola through (-1, below), (0, center), (1, above), clipped to half a pixel."""
    a, b, _ = np.polyfit([-1, 0, 1], [below, center, above], 2)
    return float(np.clip(-b / (2 * a), -0.5, 0.5)) if a < -1e-12 else 0.0


def free_extrema(extrema, live_pixels, shape, radius):
    """Those that are `radius` from every live track and every extremum kept before, in the larger coordinate."""
    taken = [(int(round(u)), int(round(v))) for u, v in live_pixels]
    kept = []
    for u, v in extrema.tolist():
        if all(max(abs(u - m), abs(v - n)) > radius for m, n in taken):
            kept.append((u, v))
            taken.append((u, v))
    return kept


def emptiest_cells_first(free, live_pixels, cell):
    """Stable order by how many live tracks and stronger free extrema the cell holds."""
    holds: dict[tuple[int, int], int] = {}
    for u, v in live_pixels:
        key = (int(u) // cell, int(v) // cell)
        holds[key] = holds.get(key, 0) + 1
    ranks = []
    for u, v in free:
        key = (u // cell, v // cell)
        ranks.append(holds.get(key, 0))
        holds[key] = ranks[-1] + 1
    return [free[i] for i in sorted(range(len(free)), key=lambda i: ranks[i])]


def climb(kappa, start, predicted, weight, sigma, max_steps):
    """Steepest ascent on the whole field F of Eq. 5; the pixel where it ends, None where it reaches no maximum."""
    height, width = kappa.shape
    vs, us = np.mgrid[:height, :width]
    distance2 = (us - predicted[0]) ** 2 + (vs - predicted[1]) ** 2
    F = kappa.astype(np.float64) + weight * sigma**2 / (distance2 + sigma**2)
    u, v = start
    for _ in range(max_steps + 1):
        if not (1 <= u < width - 1 and 1 <= v < height - 1):
            return None
        patch = F[v - 1 : v + 2, u - 1 : u + 2]
        if not patch.max() > F[v, u]:
            return u, v
        dv, du = np.unravel_index(np.argmax(patch), (3, 3))
        u, v = int(u + du - 1), int(v + dv - 1)
    return None


def climbed(kappa, predicted, weight, sigma, max_steps, gate, min_roundness=0.0):
    """Sub-pixel position (2,) of the positive maximum, round enough, within the gate; None where there is none."""
    end = climb(kappa, (int(np.rint(predicted[0])), int(np.rint(predicted[1]))), predicted, weight, sigma, max_steps)
    if end is None or kappa[end[1], end[0]] <= 0:
        return None
    u, v = end
    if min_roundness > 0 and not roundness(kappa, u, v) >= min_roundness:
        return None
    k = kappa.astype(np.float64)
    found = np.array([u + parabola_maximum(*k[v, u - 1 : u + 2]), v + parabola_maximum(*k[v - 1 : v + 2, u])])
    return found if np.linalg.norm(found - predicted) <= gate else None


def bilinear(field, x, y):
    """Sample of field (H, W, ...) at (x, y), clamped to the image."""
    height, width = field.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    total = 0.0
    for v, u in itertools.product(range(height), range(width)):
        total = total + max(0.0, 1 - abs(x - u)) * max(0.0, 1 - abs(y - v)) * field[v, u]
    return total


# --- mapping -----------------------------------------------------------------------------------------------------


def patch(image, pixel, radius):
    """The square around a rounded pixel, the border repeated."""
    u, v = (int(np.rint(x)) for x in pixel)
    pad = radius + 50
    padded = np.pad(image, pad, mode="edge")
    return padded[v + pad - radius : v + pad + radius + 1, u + pad - radius : u + pad + radius + 1].ravel()


def counting_observations(sparse_map, id_):
    """(row, keyframe) of all observations of a landmark that count."""
    rows = []
    for k in range(sparse_map.num_keyframes):
        for i in range(sparse_map.keyframe_starts[k], sparse_map.keyframe_starts[k + 1]):
            if sparse_map.obs_landmark[i] == id_ and sparse_map.obs_valid[i] and i >= sparse_map.first_observation[id_]:
                rows.append((i, k))
    return rows


def robust_cost(problem, intrinsics, sigma):
    """Eq. 6 with Eq. 3; a point behind its camera costs sigma²."""
    total = 0.0
    for c, p, pixel in zip(problem.obs_camera, problem.obs_point, problem.obs_pixels, strict=True):
        r = residual(intrinsics, problem.T_cam_world[c], problem.points_world[p], pixel)
        total += sigma**2 if r is None else geman_mcclure(np.linalg.norm(r), sigma)
    return total


def full_normal_equations(problem, intrinsics, sigma):
    """H and g of all free cameras (6 each) and then all points (3 each), dense; points seen once have no rows."""
    free = np.flatnonzero(problem.camera_is_free)
    at_camera = {int(c): 6 * n for n, c in enumerate(free)}
    size = 6 * len(free) + 3 * len(problem.points_world)
    H, g = np.zeros((size, size)), np.zeros(size)
    seen = np.bincount(problem.obs_point, minlength=len(problem.points_world))
    for c, p, pixel in zip(problem.obs_camera.tolist(), problem.obs_point.tolist(), problem.obs_pixels, strict=True):
        T, X = problem.T_cam_world[c], problem.points_world[p]
        r = residual(intrinsics, T, X, pixel)
        if r is None:
            continue
        J = np.zeros((2, size))
        J_pose, J_point = jacobians(intrinsics, T, X)
        if c in at_camera:
            J[:, at_camera[c] : at_camera[c] + 6] = J_pose
        if seen[p] >= 2:
            start = 6 * len(free) + 3 * p
            J[:, start : start + 3] = J_point
        used = np.flatnonzero(J.any(axis=0))
        w = geman_mcclure_weight(np.linalg.norm(r), sigma)
        H[np.ix_(used, used)] += w * J[:, used].T @ J[:, used]
        g[used] += w * J[:, used].T @ r
    return H, g
