# SPDX-License-Identifier: Apache-2.0
"""The subspace Gauss–Newton method (Eq. 11–12): one block at a time, 6×6 for a camera and 3×3 for a point.

Everything else is held while a block is solved for, and the derivatives are taken anew for each, so that no large
matrix is built. It lowers the cost quickly and then crawls along directions in which cameras and points move together:
those are what the Schur complement is for.
"""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.bundle_adjustment.normal_equations import (
    add_camera,
    information,
    inverse_root,
    linearize_observation,
    models_are_distorted,
    observation_error,
    squared_errors,
)
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.variables import Progress, Variables, free_slots, pinhole_model, sightings_of
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.reprojection import retract
from vitamin3d.geometry.robust import geman_mcclure
from vitamin3d.types import Array, BundleReport

BLOCK_DAMPING = 1e-9
STEP_HALVINGS = 3
MIN_OBSERVATIONS = 6
"""A camera with fewer is left where it is."""


class ByCamera(NamedTuple):
    """The observations sorted by camera, for the kernels."""

    starts: Array
    """(C + 1,) int64."""
    point: Array
    """(M,) int32."""
    pixels: Array
    """(M, 2)."""


class Scratch(NamedTuple):
    """Memory of the sweeps: a block, its right-hand side and step, and where it would lead."""

    H: Array
    """(1, 6, 6)."""
    g: Array
    """(6,)."""
    delta: Array
    """(6,)."""
    R: Array
    """(1, 3, 3)."""
    t: Array
    """(1, 3)."""
    X: Array
    """(1, 3)."""


def new_scratch() -> Scratch:
    """Memory for the sweeps."""
    return Scratch(*(np.empty(shape) for shape in ((1, 6, 6), 6, 6, (1, 3, 3), (1, 3), (1, 3))))


@inlined
def _rho(e, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """The robust cost of |r|²; a point behind the camera costs what the farthest outlier does."""
    return 1.0 / inverse_squared_sigma if e == np.inf else geman_mcclure(e, inverse_squared_sigma)[0]


@kernel
def solve_6x6(H, g, delta):  # type: ignore[no-untyped-def]
    """delta = -H⁻¹ g by Cholesky, H (1, 6, 6) given by its upper triangle and spoilt; False where it is not positive."""
    for i in range(6):
        for j in range(i, 6):
            total = H[0, i, j]
            for k in range(i):
                total -= H[0, k, i] * H[0, k, j]
            if i == j:
                if not total > 0.0:
                    return False
                H[0, i, i] = np.sqrt(total)
            else:
                H[0, i, j] = total / H[0, i, i]
    for i in range(6):
        total = -g[i]
        for k in range(i):
            total -= H[0, k, i] * delta[k]
        delta[i] = total / H[0, i, i]
    for i in range(5, -1, -1):
        total = delta[i]
        for k in range(i + 1, 6):
            total -= H[0, i, k] * delta[k]
        delta[i] = total / H[0, i, i]
    return True


@kernel
def sweep_cameras(views, by_camera, points, inverse_squared_sigma, scratch):  # type: ignore[no-untyped-def]
    """Eq. 11 for each free camera, in place: a Gauss–Newton step, halved while the cost rises, else not taken.

    Returns the largest norm of a tangent taken, and the squared norm of the gradient.
    """
    R, t, slot, models = views
    starts, obs_point, pixels = by_camera
    H, g, delta, R_new, t_new, _ = scratch
    distorted, many = models_are_distorted(models), models.shape[0] > 1
    largest, squared_gradient = 0.0, 0.0
    for c in range(R.shape[0]):
        first, last = starts[c], starts[c + 1]
        if slot[c] < 0 or last - first < MIN_OBSERVATIONS:
            continue
        H[0, :, :] = 0.0
        g[:] = 0.0
        before, m = 0.0, c if many else 0
        for i in range(first, last):
            p = obs_point[i]
            q, a, b, r0, r1, p00, p01, p10, p11 = linearize_observation(R, t, c, models, m, distorted, points, p, pixels, i)
            if q == 0.0:
                before += 1.0 / inverse_squared_sigma
                continue
            rho, g00, g01, g11, h0, h1, _, _, _ = information(r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
            before += rho
            add_camera(H, 0, g, 0, q, a, b, g00, g01, g11, h0, h1)
        for k in range(6):
            H[0, k, k] += BLOCK_DAMPING * H[0, k, k] + 1e-12
            squared_gradient += g[k] * g[k]
        if not solve_6x6(H, g, delta):
            continue
        for _ in range(STEP_HALVINGS):
            retract(delta, R[c], t[c], R_new[0], t_new[0])
            after = 0.0
            for i in range(first, last):
                after += _rho(
                    observation_error(R_new, t_new, 0, models, m, distorted, points, obs_point[i], pixels, i), inverse_squared_sigma
                )
            if after <= before:
                R[c], t[c] = R_new[0], t_new[0]
                size = 0.0
                for k in range(6):
                    size += delta[k] * delta[k]
                largest = max(largest, np.sqrt(size))
                break
            delta *= 0.5
    return largest, squared_gradient


@kernel
def sweep_points(views, sightings, points, inverse_squared_sigma, scratch):  # type: ignore[no-untyped-def]
    """Eq. 12 for each point with two observations, in place: a Gauss–Newton step, halved while the cost rises, else not taken.

    Returns the largest distance moved, the squared norm of the gradient, and the cost after the sweep.
    """
    R, t, _, models = views
    starts, cameras, pixels = sightings
    X = scratch.X
    distorted, many = models_are_distorted(models), models.shape[0] > 1
    largest, squared_gradient, cost = 0.0, 0.0, 0.0
    for p in range(points.shape[0]):
        first, last, before = starts[p], starts[p + 1], 0.0
        H0, H1, H2, H3, H4, H5, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(first, last):
            c = cameras[i]
            m = c if many else 0
            q, a, b, r0, r1, p00, p01, p10, p11 = linearize_observation(R, t, c, models, m, distorted, points, p, pixels, i)
            if q == 0.0:
                before += 1.0 / inverse_squared_sigma
                continue
            rho, g00, g01, g11, h0, h1, _, _, _ = information(r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
            before += rho
            s0, s1, s2 = q * (R[c, 0, 0] - a * R[c, 2, 0]), q * (R[c, 0, 1] - a * R[c, 2, 1]), q * (R[c, 0, 2] - a * R[c, 2, 2])
            t0, t1, t2 = q * (R[c, 1, 0] - b * R[c, 2, 0]), q * (R[c, 1, 1] - b * R[c, 2, 1]), q * (R[c, 1, 2] - b * R[c, 2, 2])
            x0, x1, x2 = g00 * s0 + g01 * t0, g00 * s1 + g01 * t1, g00 * s2 + g01 * t2
            y0, y1, y2 = g01 * s0 + g11 * t0, g01 * s1 + g11 * t1, g01 * s2 + g11 * t2
            H0 += s0 * x0 + t0 * y0
            H1 += s0 * x1 + t0 * y1
            H2 += s0 * x2 + t0 * y2
            H3 += s1 * x1 + t1 * y1
            H4 += s1 * x2 + t1 * y2
            H5 += s2 * x2 + t2 * y2
            g0 += h0 * s0 + h1 * t0
            g1 += h0 * s1 + h1 * t1
            g2 += h0 * s2 + h1 * t2
        squared_gradient += g0 * g0 + g1 * g1 + g2 * g2
        more = 1.0 + BLOCK_DAMPING
        L0, L1, L2, L3, L4, L5 = inverse_root(more * H0, H1, H2, more * H3, H4, more * H5)
        if last - first < 2 or L0 == 0.0:
            cost += before
            continue
        x, y, z = L0 * g0, L1 * g0 + L3 * g1, L2 * g0 + L4 * g1 + L5 * g2
        d0, d1, d2 = L0 * x + L1 * y + L2 * z, L3 * y + L4 * z, L5 * z
        best = before
        for _ in range(STEP_HALVINGS):
            X[0, 0], X[0, 1], X[0, 2] = points[p, 0] - d0, points[p, 1] - d1, points[p, 2] - d2
            after = 0.0
            for i in range(first, last):
                c = cameras[i]
                e = observation_error(R, t, c, models, c if many else 0, distorted, X, 0, pixels, i)
                after += _rho(e, inverse_squared_sigma)
            if after <= before:
                points[p, 0], points[p, 1], points[p, 2] = X[0, 0], X[0, 1], X[0, 2]
                largest = max(largest, np.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
                best = after
                break
            d0, d1, d2 = 0.5 * d0, 0.5 * d1, 0.5 * d2
        cost += best
    return largest, squared_gradient, cost


@kernel
def total_cost(views, sightings, points, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """The robust cost, pixels²."""
    R, t, _, models = views
    starts, cameras, pixels = sightings
    distorted, many = models_are_distorted(models), models.shape[0] > 1
    total = 0.0
    for p in range(points.shape[0]):
        for i in range(starts[p], starts[p + 1]):
            c = cameras[i]
            e = observation_error(R, t, c, models, c if many else 0, distorted, points, p, pixels, i)
            total += _rho(e, inverse_squared_sigma)
    return total


def by_camera_of(problem: BundleProblem) -> ByCamera:
    """The observations as the problem has them, with where each camera's start."""
    starts = np.searchsorted(problem.obs_camera, np.arange(len(problem.T_cam_world) + 1))
    return ByCamera(starts, problem.obs_point, np.ascontiguousarray(problem.obs_pixels))


def adjust_subspace(
    problem: BundleProblem, camera: Camera, sigma_px: float, sweeps: int, relative_gain: float = 1e-5
) -> tuple[BundleProblem, BundleReport]:
    """Sweeps over all free cameras (Eq. 11) and then all points (Eq. 12); the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each sweep; it ends when a sweep gains less than relative_gain.
    """
    variables = Variables.of(problem, pinhole_model(camera))
    progress = sweep_until(problem, variables, 1.0 / sigma_px**2, sweeps, relative_gain)
    out = np.empty(len(problem.obs_camera))
    squared_errors(variables.views(free_slots(problem)), sightings_of(problem), variables.points, out)
    return variables.written_to(problem), progress.report(out, sigma_px)


def sweep_until(problem: BundleProblem, variables: Variables, weight: float, sweeps: int, relative_gain: float) -> Progress:
    """Sweeps over cameras and points, `variables` changed in place, until one gains less than a share of the cost; weight = 1 / sigma²."""
    sightings, by_camera, scratch = sightings_of(problem), by_camera_of(problem), new_scratch()
    views, progress = variables.views(free_slots(problem)), Progress()
    progress.costs.append(total_cost(views, sightings, variables.points, weight))
    for _ in range(sweeps):
        pose, by_pose = sweep_cameras(views, by_camera, variables.points, weight, scratch)
        point, by_point, cost = sweep_points(views, sightings, variables.points, weight, scratch)
        progress.costs.append(min(cost, progress.costs[-1]))
        progress.steps.append((float(np.sqrt(by_pose + by_point)), pose, point))
        if progress.costs[-2] - progress.costs[-1] <= relative_gain * progress.costs[-2]:
            progress.stopped = "gain"
            break
    return progress
