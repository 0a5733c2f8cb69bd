# SPDX-License-Identifier: Apache-2.0
"""The subspace Gauss–Newton method (Eq. 11–12): one block at a time, 6×6 for a camera and 3×3 for a point.

Everything else is held while a block is solved for, so that no large matrix is built; the derivatives are taken anew
for each block, or H dx = -g is solved by sweeps over its blocks before the step is taken (`adjust_by_inner_sweeps`). It
lowers the cost quickly and then crawls along directions in which cameras and points move together: those are what the
Schur complement is for.
"""

from typing import NamedTuple

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d._simd import WIDTH, any_of, greatest, scatter, select, splat, total
from vitamin3d.bundle_adjustment.normal_equations import (
    NormalEquations,
    accumulate,
    add_camera,
    add_point,
    by_point,
    inverse_root,
    move_cameras,
    move_points,
    no_camera,
    no_point,
    point_step,
    weighted,
    write_camera,
)
from vitamin3d.bundle_adjustment.observations import (
    Sightings,
    camera_rows,
    cost_of_camera,
    information,
    linearize_rows,
    linearize_sighting,
    models_are_distorted,
    point_group,
    robust_cost,
    squared_error_sighting,
    total_cost,
)
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.variables import Progress, Variables, free_slots, pinhole_model, sightings_of, squared_errors_of
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.cholesky import solve_6x6
from vitamin3d.geometry.reprojection import in_camera, linearize_simd, model_of, points_of, pose_of, retract
from vitamin3d.types import Array, BundleReport

BLOCK_DAMPING = 1e-9
STEP_HALVINGS = 3
INNER_SWEEPS = 5
MIN_OBSERVATIONS = 6
"""A camera with fewer is left where it is."""


class Scratch(NamedTuple):
    """Memory of a sweep over cameras: a block, its right-hand side and step, and where it would lead."""

    sums: Array
    """(27,)."""
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


def new_scratch() -> Scratch:
    """Memory for the sweeps."""
    return Scratch(*(np.empty(shape) for shape in (27, (1, 6, 6), 6, 6, (1, 3, 3), (1, 3))))


@kernel
def sweep_cameras(views, sightings, points, inverse_squared_sigma, scratch):  # type: ignore[no-untyped-def]
    """Eq. 11 for each free camera, in place: a Gauss–Newton step, halved while the cost rises, else not taken.

    Returns the largest norm of a tangent taken, and the squared norm of the gradient.
    """
    R, t, slot, models = views
    sums, H, g, delta, R_new, t_new = scratch
    is_distorted, largest, squared_gradient = models_are_distorted(models), 0.0, 0.0
    for c in range(R.shape[0]):
        first, last = sightings.camera_starts[c], sightings.camera_starts[c + 1]
        if slot[c] < 0 or last - first < MIN_OBSERVATIONS:
            continue
        pose, model = pose_of(R, t, c), model_of(models, c if models.shape[0] > 1 else 0)
        block, costs = no_camera(), splat(0.0)
        for i in range(first, last, WIDTH):
            is_there, seen = linearize_rows(sightings, points, pose, model, is_distorted, i, last)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = seen
            rho, _, g00, g01, g11, h0, h1, _, _, _ = information(is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
            costs = costs + rho
            block = add_camera(block, q, a, b, g00, g01, g11, h0, h1)
        before = total(costs)
        write_camera(block, sums, H[0], g)
        for k in range(6):
            H[0, k, k] += BLOCK_DAMPING * H[0, k, k] + 1e-12
            squared_gradient += g[k] * g[k]
        if not solve_6x6(H, g, delta):
            continue
        for _ in range(STEP_HALVINGS):
            retract(delta, R[c], t[c], R_new[0], t_new[0])
            there = pose_of(R_new, t_new, 0)
            if cost_of_camera(sightings, points, there, model, is_distorted, first, last, inverse_squared_sigma) <= before:
                R[c], t[c] = R_new[0], t_new[0]
                size = 0.0
                for k in range(6):
                    size += delta[k] * delta[k]
                largest = max(largest, np.sqrt(size))
                break
            delta *= 0.5
    return largest, squared_gradient


@kernel
def solve_cameras(views, sightings, points, moved, inverse_squared_sigma, scratch, delta):  # type: ignore[no-untyped-def]
    """Eq. 11 without taking the step: delta (F, 6) of the free cameras from `views` when the points go from `points` to `moved`.

    Derivatives and weights are those of `views` and `points`.
    """
    R, t, slot, models = views
    sums, H, g, step, _, _ = scratch
    is_distorted = models_are_distorted(models)
    for c in range(R.shape[0]):
        first, last, f = sightings.camera_starts[c], sightings.camera_starts[c + 1], slot[c]
        if f < 0 or last - first < MIN_OBSERVATIONS:
            continue
        pose, model, block = pose_of(R, t, c), model_of(models, c if models.shape[0] > 1 else 0), no_camera()
        for i in range(first, last, WIDTH):
            _, is_there, X, Y, Z, u, v = camera_rows(sightings.camera_point, sightings.camera_pixels, points, i, last)
            _, _, X1, Y1, Z1, _, _ = camera_rows(sightings.camera_point, sightings.camera_pixels, moved, i, last)
            x, y, z = in_camera(pose, X, Y, Z)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = linearize_simd(x, y, z, is_distorted, model, u, v)
            _, _, g00, g01, g11, h0, h1, _, _, _ = information(is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
            J, d0, d1, d2 = by_point(pose, q, a, b), X1 - X, Y1 - Y, Z1 - Z
            da, db = J[0] * d0 + J[1] * d1 + J[2] * d2, J[3] * d0 + J[4] * d1 + J[5] * d2
            block = add_camera(block, q, a, b, g00, g01, g11, h0 + (g00 * da + g01 * db), h1 + (g01 * da + g11 * db))
        write_camera(block, sums, H[0], g)
        for k in range(6):
            H[0, k, k] += BLOCK_DAMPING * H[0, k, k] + 1e-12
        if solve_6x6(H, g, step):
            delta[f] = step


@kernel
def sweep_points(views, sightings, points, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """Eq. 12 for each point with two observations, in place: a Gauss–Newton step, halved while the cost rises, else not taken.

    Returns the largest distance moved, the squared norm of the gradient, and the cost after the sweep.
    """
    is_distorted = models_are_distorted(views.models)
    farthest, squared_gradient, cost = splat(0.0), splat(0.0), splat(0.0)
    for start in range(0, points.shape[0], WIDTH):
        p, is_new, first, count, longest = point_group(sightings, start)
        if longest == 0:
            continue
        X, Y, Z = points_of(points, p)
        block, before = no_point(), splat(0.0)
        for n in range(longest):
            is_there, _, pose, _, seen = linearize_sighting(views, sightings, is_distorted, X, Y, Z, first, count, n)
            is_seen, q, a, b, r0, r1, p00, p01, p10, p11 = seen
            rho, _, g00, g01, g11, h0, h1, _, _, _ = information(is_there, is_seen, r0, r1, p00, p01, p10, p11, inverse_squared_sigma, 0.0)
            before = before + rho
            J = by_point(pose, q, a, b)
            block = add_point(block, J, weighted(J, g00, g01, g11), h0, h1)
        g0, g1, g2 = block[6], block[7], block[8]
        squared_gradient = squared_gradient + select(is_new, g0 * g0 + g1 * g1 + g2 * g2, 0.0)
        is_open, L = inverse_root(block, BLOCK_DAMPING, count)
        d0, d1, d2 = point_step(L, g0, g1, g2)
        best = before
        for _ in range(STEP_HALVINGS):
            x, y, z, after = X - d0, Y - d1, Z - d2, splat(0.0)
            for n in range(longest):
                is_there, e = squared_error_sighting(views, sightings, is_distorted, x, y, z, first, count, n)
                after = after + robust_cost(is_there, e, inverse_squared_sigma)
            is_better = is_open & (after <= before)
            X, Y, Z, best = select(is_better, x, X), select(is_better, y, Y), select(is_better, z, Z), select(is_better, after, best)
            way = d0 * d0 + d1 * d1 + d2 * d2
            farthest = select(is_better & (way > farthest), way, farthest)
            is_open = is_open ^ is_better
            if not any_of(is_open):
                break
            d0, d1, d2 = 0.5 * d0, 0.5 * d1, 0.5 * d2
        scatter(points, 3 * p, X)
        scatter(points, 3 * p + 1, Y)
        scatter(points, 3 * p + 2, Z)
        cost = cost + select(is_new, best, 0.0)
    return np.sqrt(greatest(farthest)), total(squared_gradient), total(cost)


def adjust_subspace(
    problem: BundleProblem, camera: Camera, sigma_px: float, sweeps: int, relative_gain: float = 1e-5
) -> tuple[BundleProblem, BundleReport]:
    """Sweeps over all free cameras (Eq. 11) and then all points (Eq. 12); the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each sweep; it ends when a sweep gains less than relative_gain.
    """
    variables = Variables.of(problem, pinhole_model(camera))
    progress = sweep_until(problem, variables, 1.0 / sigma_px**2, sweeps, relative_gain)
    return variables.written_to(problem), progress.report(squared_errors_of(problem, variables), sigma_px)


def sweep_until(problem: BundleProblem, variables: Variables, weight: float, sweeps: int, relative_gain: float) -> Progress:
    """Sweeps over cameras and points, `variables` changed in place, until one gains less than a share of the cost; weight = 1 / sigma²."""
    sightings, scratch = sightings_of(problem), new_scratch()
    views, progress = variables.views(free_slots(problem)), Progress()
    progress.costs.append(total_cost(views, sightings, variables.points, weight))
    for _ in range(sweeps):
        pose, by_pose = sweep_cameras(views, sightings, variables.points, weight, scratch)
        point, by_point, cost = sweep_points(views, sightings, variables.points, weight)
        progress.costs.append(min(cost, progress.costs[-1]))
        progress.steps.append((float(np.sqrt(by_pose + by_point)), pose, point))
        if progress.costs[-2] - progress.costs[-1] <= relative_gain * progress.costs[-2]:
            progress.stopped = "gain"
            break
    return progress


def adjust_by_inner_sweeps(
    problem: BundleProblem, camera: Camera, sigma_px: float, steps: int, relative_gain: float = 1e-5
) -> tuple[BundleProblem, BundleReport]:
    """Like `adjust_subspace`, with the derivatives taken once a step, whose H dx = -g is solved by sweeps over the blocks."""
    variables, progress = step_until(problem, Variables.of(problem, pinhole_model(camera)), 1.0 / sigma_px**2, steps, relative_gain)
    return variables.written_to(problem), progress.report(squared_errors_of(problem, variables), sigma_px)


def step_until(problem: BundleProblem, variables: Variables, weight: float, steps: int, relative_gain: float) -> tuple[Variables, Progress]:
    """Steps of `INNER_SWEEPS` sweeps each, until one gains less than a share of the cost; weight = 1 / sigma²."""
    sightings, slot, progress = sightings_of(problem), free_slots(problem), Progress()
    equations = NormalEquations.zeros(int(slot.max(initial=-1)) + 1, 6, 0, len(problem.points_world))
    progress.costs.append(total_cost(variables.views(slot), sightings, variables.points, weight))
    for _ in range(steps):
        moved, cost, delta, gradient = _inner_sweeps(variables, slot, sightings, weight, equations)
        for _ in range(STEP_HALVINGS):
            if cost <= progress.costs[-1]:
                break
            delta = 0.5 * delta
            moved = _at(variables, slot, delta, variables.points + 0.5 * (moved.points - variables.points))
            cost = total_cost(moved.views(slot), sightings, moved.points, weight)
        if not cost <= progress.costs[-1]:
            progress.stopped = "no descent"
            break
        pose, point = np.linalg.norm(delta, axis=1), np.linalg.norm(moved.points - variables.points, axis=1)
        progress.steps.append((gradient, float(pose.max(initial=0.0)), float(point.max(initial=0.0))))
        progress.costs.append(cost)
        variables = moved
        if progress.costs[-2] - progress.costs[-1] <= relative_gain * progress.costs[-2]:
            progress.stopped = "gain"
            break
    return variables, progress


def _inner_sweeps(
    variables: Variables, slot: Array, sightings: Sightings, weight: float, equations: NormalEquations
) -> tuple[Variables, float, Array, float]:
    """Where the sweeps over H dx = -g lead, the cost there, the cameras' steps (F, 6) and the norm of the gradient."""
    views, delta, scratch = variables.views(slot), np.zeros((len(equations.H_cameras), 6)), new_scratch()
    accumulate(views, sightings, variables.points, np.zeros((8, 0)), weight, 0.0, BLOCK_DAMPING, equations, is_reduced=False)
    gradient = float(np.sqrt((equations.gradient**2).sum() + (equations.point_gradient**2).sum()))
    moved, cost = _at(variables, slot, delta, variables.points.copy()), np.inf
    for _ in range(INNER_SWEEPS):
        solve_cameras(views, sightings, variables.points, moved.points, weight, scratch, delta)
        moved = _at(variables, slot, delta, moved.points)
        cost = move_points(views, moved.views(slot), sightings, variables.points, delta, weight, 0.0, equations, moved.points)
    return moved, cost, delta, gradient


def _at(variables: Variables, slot: Array, delta: Array, points: Array) -> Variables:
    """The cameras after steps delta (F, 6), and these points."""
    moved = Variables(np.empty_like(variables.R), np.empty_like(variables.t), points, variables.models)
    move_cameras(variables.views(slot), delta, moved.R, moved.t)
    return moved
