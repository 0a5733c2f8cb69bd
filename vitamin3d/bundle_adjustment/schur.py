# SPDX-License-Identifier: Apache-2.0
"""Levenberg–Marquardt on the reduced camera system (Eq. 9–10): all variables move together, the points eliminated."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.normal_equations import (
    NormalEquations,
    accumulate,
    move_cameras,
    move_points,
    scale_upper,
)
from vitamin3d.bundle_adjustment.observations import Sightings, squared_errors
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.subspace import sweep_points
from vitamin3d.bundle_adjustment.variables import Progress, Variables, free_slots, pinhole_model, sightings_of
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, BundleReport

FIRST_DAMPING = 1e-4
MIN_DAMPING = 1e-9
MAX_DAMPING = 1e8
MOST_BEND = 0.5
"""More of the kernel's bending makes the steps so long that many are refused."""
NEAR_GAIN = 0.02
"""The bending is used after a step that gained no more than this share: far from the minimum it hinders."""
LEAST_INFORMATION = 1e-12
"""What is left of a shared parameter's information when all else is free is rounding below this share of it."""
NO_BASIS = np.zeros((8, 0))


@dataclass(frozen=True)
class Step:
    """A damped step and what it would cost."""

    moved: Variables
    cost_before: float
    cost: float
    gradient_norm: float
    """Of the robust cost by all free variables before the step, halved as in the normal equations."""
    largest_pose: float
    """Largest norm of a camera's tangent [translation, rotation]."""
    largest_point: float
    """Largest distance."""
    shared: Array
    """(K,) step of the shared parameters."""
    information: Array
    """(K, K) what is known of them when all else is free."""
    information_alone: Array
    """(K,) diagonal of it when all else is held."""


class ReducedSystem:
    """The normal equations of one problem, their memory kept from step to step."""

    def __init__(
        self, sightings: Sightings, slot: Array, sigma_px: float, basis: Array = NO_BASIS, own: bool = False, prior: Array | None = None
    ) -> None:
        """With `basis` (8, K) the cameras' models move too: all together, or each on its `own`; `prior` (K,) is the information
        on the shared parameters around where they start."""
        self.sightings, self.slot, self.inverse_squared_sigma, self.basis = sightings, slot, 1.0 / sigma_px**2, basis
        num_free, K = int(slot.max(initial=-1)) + 1, basis.shape[1]
        self.num_shared, self.width = 0 if own else K, 6 + K if own else 6
        self.prior = np.zeros(self.num_shared) if prior is None else prior
        self.from_start = np.zeros(self.num_shared)
        self.camera_prior: CameraPrior | None = None
        self.equations = NormalEquations.zeros(num_free, self.width, self.num_shared, len(sightings.starts) - 1)

    def build(self, variables: Variables, damping: float, most_bend: float) -> tuple[float, Array]:
        """The damped reduced system, complete, in `equations.reduced`; the cost, and the gradient (N,) without the points'."""
        e, K, D = self.equations, self.num_shared, self.width
        views = variables.views(self.slot)
        cost = accumulate(views, self.sightings, variables.points, self.basis, self.inverse_squared_sigma, most_bend, damping, e)
        F = len(e.H_cameras)
        border = D * F
        e.gradient[border:] += self.prior * self.from_start
        e.H_shared[np.diag_indices(K)] += self.prior
        for block in (e.H_cameras, e.H_shared[None]):
            block[:, range(block.shape[1]), range(block.shape[1])] *= 1.0 + damping
        rows = D * np.arange(F)[:, None] + np.arange(D)
        e.reduced[rows[:, :, None], rows[:, None, :]] += e.H_cameras
        if K:
            e.reduced[rows[:, :6, None], border + np.arange(K)] += e.H_border
            e.reduced[border:, border:] += e.H_shared
        if self.camera_prior is not None:
            self.camera_prior.add_to(variables.R, variables.t, self.slot, damping, e.reduced, e.gradient)
        return cost + self.prior_cost(variables, np.zeros(K)), e.gradient

    def step(self, variables: Variables, damping: float, most_bend: float = 0.0) -> Step:
        """The step from `variables`, not yet taken."""
        e, K, F = self.equations, self.num_shared, len(self.equations.H_cameras)
        cost_before, gradient = self.build(variables, damping, most_bend)
        norm = float(np.sqrt((gradient**2).sum() + (e.point_gradient**2).sum()))
        alone = np.array(np.diag(e.H_shared))
        solved = solve_bordered(e.reduced, e.lifted - gradient, K)
        if solved is None:
            return Step(variables, cost_before, np.inf, norm, 0.0, 0.0, np.zeros(K), np.zeros((K, K)), alone)
        flat, information = solved
        delta, shared = np.ascontiguousarray(flat[: len(flat) - K]).reshape(F, self.width), flat[len(flat) - K :]
        moved = self._moved(variables, delta, shared)
        cost = move_points(
            variables.views(self.slot), moved.views(self.slot), self.sightings, variables.points, delta,
            self.inverse_squared_sigma, most_bend, e, moved.points,
        )  # fmt: skip
        cost += self.prior_cost(moved, shared)
        cost = cost if np.isfinite(cost) and (moved.models[:, :2] > 0).all() else np.inf
        largest_pose = float(np.sqrt((delta[:, :6] ** 2).sum(axis=1)).max(initial=0.0))
        largest_point = float(np.sqrt(((moved.points - variables.points) ** 2).sum(axis=1)).max(initial=0.0))
        return Step(moved, cost_before, cost, norm, largest_pose, largest_point, shared, information, alone)

    def prior_cost(self, variables: Variables, shared: Array) -> float:
        """What the priors add to the cost at `variables`, the shared parameters a step of `shared` (K,) from here."""
        cost = float(self.prior @ (self.from_start + shared) ** 2)
        return cost if self.camera_prior is None else cost + self.camera_prior.cost(variables.R, variables.t)

    def _moved(self, variables: Variables, delta: Array, shared: Array) -> Variables:
        models = variables.models
        if self.width > 6:
            models = models.copy()
            free = self.slot >= 0
            models[free] += delta[self.slot[free], 6:] @ self.basis.T
        elif self.num_shared:
            models = models + self.basis @ shared
        moved = Variables(np.empty_like(variables.R), np.empty_like(variables.t), np.empty_like(variables.points), models)
        move_cameras(variables.views(self.slot), delta, moved.R, moved.t)
        return moved

    def squared_errors(self, variables: Variables) -> Array:
        """(M,) in pixels², in the problem's order."""
        out, (*_, starts, point, pixels) = np.empty(len(self.sightings.camera)), self.sightings
        squared_errors(variables.views(self.slot), starts, point, pixels, variables.points, out)
        return out


def solve_bordered(reduced: Array, right: Array, num_shared: int) -> tuple[Array, Array] | None:
    """Solves a symmetric system, given by its upper triangle and spoilt, whose last variables are shared; None: not positive.

    Returns:
        The solution (N,), and what is known of the shared variables when the others are free too (K, K).
    """
    N, K = len(right), num_shared
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    scale_upper(reduced, scale)
    reduced[np.diag_indices(N)] += 1e-13
    A, B, C = reduced[: N - K, : N - K], reduced[: N - K, N - K :], reduced[N - K :, N - K :]
    X = np.column_stack([B, (scale * right)[: N - K]])
    if N > K:
        _, X, info = lapack.dposv(A.T if K == 0 else np.asfortranarray(A.T), X, lower=1, overwrite_a=1)
        if info:
            return None
    M = np.triu(C) + np.triu(C, 1).T - B.T @ X[:, :K]
    shared = _solve_weak(M, (scale * right)[N - K :] - B.T @ X[:, K])
    out = np.concatenate([X[:, K] - X[:, :K] @ shared, shared]) * scale
    inverse = 1.0 / scale[N - K :]
    return out, M * inverse[:, None] * inverse[None, :]


def _solve_weak(M: Array, rest: Array) -> Array:
    """M⁻¹ rest for a symmetric M (K, K), directions without information left alone."""
    values, vectors = np.linalg.eigh(M)
    along = vectors.T @ rest
    return np.asarray(vectors @ np.where(values > LEAST_INFORMATION, along / np.maximum(values, LEAST_INFORMATION), 0.0))


def adjust_accelerated(
    problem: BundleProblem, camera: Camera, sigma_px: float, iterations: int, relative_gain: float = 1e-5, prior: CameraPrior | None = None
) -> tuple[BundleProblem, BundleReport]:
    """Like `adjust_schur`, with a sweep of the subspace method over the points (Eq. 12) in each step.

    All cameras move together and then each point alone, by its own non-linear equations: fewer steps, each a fifth longer.
    """
    return _adjust(problem, camera, sigma_px, iterations, relative_gain, 1, prior)


def adjust_schur(
    problem: BundleProblem, camera: Camera, sigma_px: float, iterations: int, relative_gain: float = 1e-5, prior: CameraPrior | None = None
) -> tuple[BundleProblem, BundleReport]:
    """Levenberg–Marquardt with the points eliminated, Geman–McClure weights; the cost never rises.

    Returns:
        The solved problem, and a report with the cost after each accepted or refused step; it ends when a step gains less than
        relative_gain.
    """
    return _adjust(problem, camera, sigma_px, iterations, relative_gain, 0, prior)


def _adjust(
    problem: BundleProblem,
    camera: Camera,
    sigma_px: float,
    iterations: int,
    relative_gain: float,
    sweeps: int,
    prior: CameraPrior | None,
) -> tuple[BundleProblem, BundleReport]:
    system = ReducedSystem(sightings_of(problem), free_slots(problem), sigma_px)
    system.camera_prior = prior
    variables, progress = minimise(system, Variables.of(problem, pinhole_model(camera)), iterations, relative_gain, sweeps)
    return variables.written_to(problem), progress.report(system.squared_errors(variables), sigma_px)


def minimise(
    system: ReducedSystem,
    variables: Variables,
    iterations: int,
    relative_gain: float,
    point_sweeps: int = 0,
    is_settled: Callable[[Step, float], bool] | None = None,
    first_damping: float = FIRST_DAMPING,
) -> tuple[Variables, Progress]:
    """Damped steps until one of them gains less than a share of the cost; after each the points alone are swept, if asked for.

    With `is_settled`, which is asked about each step and its damping, that must be so as well.
    """
    progress, damping, is_near = Progress(), first_damping, False
    for _ in range(iterations):
        step = system.step(variables, damping, MOST_BEND if is_near else 0.0)
        cost = _swept(system, step, point_sweeps)
        if not progress.costs:
            progress.costs.append(step.cost_before)
        accepted = cost <= progress.costs[-1]
        progress.costs.append(min(cost, progress.costs[-1]))
        progress.steps.append((step.gradient_norm, step.largest_pose, step.largest_point))
        gain = progress.costs[-2] - progress.costs[-1]
        is_near = accepted and gain <= NEAR_GAIN * progress.costs[-1]
        if accepted:
            settled = is_settled is None or is_settled(step, damping)
            system.from_start = system.from_start + step.shared
            variables, damping = step.moved, max(MIN_DAMPING, 0.1 * damping)
            if settled and gain <= relative_gain * progress.costs[-1]:
                progress.stopped = "gain" if is_settled is None else "settled"
                break
        else:
            damping *= 10.0
        if damping > MAX_DAMPING:
            progress.stopped = "no descent"
            break
    if not progress.costs:
        progress.costs.append(system.build(variables, 0.0, 0.0)[0])
    return variables, progress


def _swept(system: ReducedSystem, step: Step, sweeps: int) -> float:
    """The cost after the step and so many sweeps over its points."""
    cost = step.cost
    for _ in range(sweeps if np.isfinite(cost) else 0):
        views = step.moved.views(system.slot)
        *_, cost = sweep_points(views, system.sightings, step.moved.points, system.inverse_squared_sigma)
        cost += system.prior_cost(step.moved, step.shared)
    return cost
