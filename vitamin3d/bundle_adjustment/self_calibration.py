# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: bundle adjustment in which parameters of the one camera are free as well, and how well they are known.

A map holds ideal pixels, which depend on the calibration; what was measured are distorted pixels. So the residual
here is in distorted pixels, and the ideal ones are computed anew with the camera that is found.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from vitamin3d.bundle_adjustment.normal_equations import (
    NormalEquations,
    Sightings,
    Views,
    accumulate,
    move_cameras,
    move_points,
    squared_errors,
)
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.errors import InputError
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array

PARAMETERS = ("f", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""`f` moves fx and fy together, their ratio kept."""
FIRST_DAMPING = 1e-5
MIN_DAMPING = 1e-9
MAX_DAMPING = 1e6
SETTLED_DAMPING = 1e-6
SETTLED_DEVIATIONS = 0.1
"""The parameters are settled when an almost undamped step moves none of them by more than this share of its deviation."""
MOST_BEND = 0.5
"""More makes the steps so long that many are refused."""
NEAR_GAIN = 0.02
"""The kernel's bending is used where a step gains no more than this share: far from the minimum it hinders."""
LEAST_INFORMATION = 1e-12
"""What is left of a parameter's information when poses and points are free is rounding below this share of it."""


@dataclass(frozen=True)
class CalibrationReport:
    """What a self-calibration did and how well it knows the parameters."""

    names: tuple[str, ...]
    """The free parameters."""
    covariance: Array
    """(K, K) in their order and units (pixels; k1 k2 p1 p2 without), poses, points and gauge free as well."""
    deviations: Mapping[str, float]
    """Standard deviation by parameter: square roots of the covariance's diagonal."""
    deviations_px: Mapping[str, float]
    """How far one deviation of the parameter alone moves the farthest corner of the picture, pixels."""
    noise_px: float
    """Robust standard deviation of a residual's coordinate, corrected for the parameters that were fitted."""
    costs: Array
    """(I + 1,) robust cost before the first and after each step."""
    converged: bool
    stopped: str
    """Why: `settled`, `iterations`, `no descent`."""


def adjust_with_intrinsics(
    problem: BundleProblem,
    camera: Camera,
    free: Sequence[str],
    sigma_px: float,
    iterations: int = 30,
    relative_gain: float = 1e-4,
    priors: Mapping[str, float] | None = None,
) -> tuple[BundleProblem, Camera, CalibrationReport]:
    """Levenberg–Marquardt over poses, points and `free` parameters of the camera, Geman–McClure weights; the cost never rises.

    Args:
        problem: ideal pixels of `camera`. Its fixed cameras hold the gauge; with one of them the scale is free, harmlessly.
        free: names out of `PARAMETERS`; `f` excludes `fx` and `fy`.
        relative_gain: a step that gains less ends the adjustment, once the parameters are settled.
        priors: standard deviations of parameters around where they start, in their own units.

    Returns:
        The solved problem with the ideal pixels of the new camera (NaN where its distortion cannot be inverted),
        the new camera, and the report.

    Raises:
        InputError: an unknown, doubled or contradictory name.
    """
    s = _State(problem, camera, free, sigma_px, priors or {})
    costs: list[float] = []
    damping, is_near, stopped = FIRST_DAMPING, False, "iterations"
    for _ in range(iterations):
        step = s.step(damping, MOST_BEND if is_near else 0.0)
        if not costs:
            costs.append(step.cost_before)
        accepted = step.cost <= costs[-1]
        costs.append(min(step.cost, costs[-1]))
        is_near = accepted and costs[-2] - costs[-1] <= NEAR_GAIN * costs[-1]
        if accepted:
            s.take(step)
            is_settled = damping <= SETTLED_DAMPING and step.in_deviations <= SETTLED_DEVIATIONS
            damping = max(MIN_DAMPING, 0.1 * damping)
            if is_settled and costs[-2] - costs[-1] <= relative_gain * costs[-1]:
                stopped = "settled"
                break
        else:
            damping *= 10.0
        if damping > MAX_DAMPING:
            stopped = "no descent"
            break
    solved, refined = s.result()
    return solved, refined, _report(s, costs, stopped)


def calibration_basis(camera: Camera, free: Sequence[str]) -> Array:
    """(8, K): how fx fy cx cy k1 k2 p1 p2 move with the free parameters.

    Raises:
        InputError: an unknown, doubled or contradictory name.
    """
    unknown = [name for name in free if name not in PARAMETERS]
    if unknown:
        raise InputError(f"no camera parameter is called {unknown[0]!r}; there are {' '.join(PARAMETERS)}")
    if len(set(free)) < len(free) or ("f" in free and {"fx", "fy"} & set(free)):
        raise InputError(f"the free camera parameters {' '.join(free)} name one twice ('f' is fx and fy together)")
    basis = np.zeros((8, len(free)))
    for k, name in enumerate(free):
        if name == "f":
            basis[:2, k] = 1.0, camera.fy / camera.fx
        else:
            basis[PARAMETERS.index(name) - 1, k] = 1.0
    return basis


@dataclass(frozen=True)
class _Step:
    R: Array
    t: Array
    points: Array
    model: Array
    cost_before: float
    cost: float
    in_deviations: float
    """The largest step of a parameter, in its standard deviations."""


class _State:
    """The variables as contiguous arrays, observations sorted by point."""

    def __init__(self, problem: BundleProblem, camera: Camera, free: Sequence[str], sigma_px: float, priors: Mapping[str, float]) -> None:
        self.problem, self.camera, self.free, self.squared_sigma = problem, camera, tuple(free), sigma_px**2
        self.basis = calibration_basis(camera, free)
        measured = camera.distort(problem.obs_pixels)
        self.sightings = Sightings(problem.point_starts, problem.obs_camera[problem.point_order], measured[problem.point_order])
        self.slot = np.where(problem.camera_is_free, np.cumsum(problem.camera_is_free) - 1, -1)
        self.R = np.ascontiguousarray(problem.T_cam_world[:, :3, :3])
        self.t = np.ascontiguousarray(problem.T_cam_world[:, :3, 3])
        self.points, self.model = np.array(problem.points_world), camera.model
        self.noise_px = _noise(self._errors(), self.squared_sigma, self.num_variables)
        self.prior_information = np.array([(self.noise_px / priors[name]) ** 2 if name in priors else 0.0 for name in self.free])
        self.from_start = np.zeros(len(self.free))

    @property
    def views(self) -> Views:
        return Views(self.R, self.t, self.slot, self.model)

    @property
    def num_variables(self) -> int:
        used = np.diff(self.sightings.starts) >= 2
        return int(6 * self.problem.camera_is_free.sum() + 3 * used.sum() + len(self.free))

    def _errors(self) -> Array:
        out = np.empty(len(self.sightings.camera))
        squared_errors(self.views, self.sightings, self.points, out)
        return out

    def equations(self, damping: float, most_bend: float) -> tuple[NormalEquations, float]:
        """The reduced system with its diagonal, damped; and the cost."""
        F, K = int(self.slot.max(initial=-1)) + 1, len(self.free)
        e = NormalEquations.zeros(F, K, len(self.points))
        cost = accumulate(self.views, self.sightings, self.points, self.basis, self.squared_sigma, most_bend, damping, e)
        cost += float(self.prior_information @ self.from_start**2)
        e.right[6 * F :] -= self.prior_information * self.from_start
        e.H_shared[np.diag_indices(K)] += self.prior_information
        grid = 6 * np.arange(F)[:, None] + np.arange(6)
        e.H_cameras[:, range(6), range(6)] *= 1.0 + damping
        e.H_shared[np.diag_indices(K)] *= 1.0 + damping
        e.reduced[grid[:, :, None], grid[:, None, :]] += e.H_cameras
        e.reduced[: 6 * F, 6 * F :] += e.H_border.reshape(6 * F, K)
        e.reduced[6 * F :, 6 * F :] += e.H_shared
        return e, cost

    def step(self, damping: float, most_bend: float) -> _Step:
        """The damped step from here, and the costs before and after it."""
        e, cost_before = self.equations(damping, most_bend)
        K = len(self.free)
        solved = solve_bordered(e.reduced, e.right, K)
        if solved is None:
            return _Step(self.R, self.t, self.points, self.model, cost_before, np.inf, np.inf)
        delta, information = solved
        size, F = delta[len(delta) - K :], (len(delta) - K) // 6
        deviations = self.noise_px * np.sqrt(np.maximum(np.diag(_covariance(information, np.diag(e.H_shared))), 1e-300))
        R, t, points = np.empty_like(self.R), np.empty_like(self.t), np.empty_like(self.points)
        poses, model_step = np.ascontiguousarray(delta[: 6 * F]).reshape(F, 6), self.basis @ size
        move_cameras(self.views, poses, R, t)
        moved = Views(R, t, self.slot, self.model + model_step)
        cost = move_points(
            self.views, moved, self.sightings, self.points, model_step, poses, self.squared_sigma, most_bend, e.gradient, e.root, points
        )
        cost += float(self.prior_information @ (self.from_start + size) ** 2)
        cost = cost if np.isfinite(cost) and moved.model[0] > 0 and moved.model[1] > 0 else np.inf
        return _Step(R, t, points, moved.model, cost_before, cost, float(np.max(np.abs(size) / deviations, initial=0.0)))

    def take(self, step: _Step) -> None:
        self.from_start = self.from_start + np.linalg.pinv(self.basis) @ (step.model - self.model)
        self.R, self.t, self.points, self.model = step.R, step.t, step.points, step.model

    def covariance(self) -> tuple[Array, float]:
        """(K, K) of the free parameters, everything else marginalised; and the noise in pixels."""
        e, _ = self.equations(0.0, 0.0)
        K = len(self.free)
        noise_px = _noise(self._errors(), self.squared_sigma, self.num_variables)
        solved = solve_bordered(e.reduced, e.right, K)
        information = np.zeros((K, K)) if solved is None else solved[1]
        return noise_px**2 * _covariance(information, np.diag(e.H_shared)), noise_px

    def result(self) -> tuple[BundleProblem, Camera]:
        refined = self.camera.with_model(self.model)
        U, _, Vt = np.linalg.svd(self.R)
        poses = np.array(self.problem.T_cam_world)
        free = self.problem.camera_is_free
        poses[free, :3, :3], poses[free, :3, 3] = (U @ Vt)[free], self.t[free]
        pixels = refined.undistort(self.camera.distort(self.problem.obs_pixels))
        return dataclasses.replace(self.problem, T_cam_world=poses, points_world=self.points, obs_pixels=pixels), refined


def solve_bordered(reduced: Array, right: Array, num_shared: int) -> tuple[Array, Array] | None:
    """Solves a symmetric system given by its upper triangle whose last variables are shared; None where it is not positive.

    Returns:
        The solution (N,), and what is known of the shared variables when the others are free too (K, K).
    """
    N, K = len(right), num_shared
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    scaled = np.triu(reduced) * scale[:, None] * scale[None, :]
    scaled[np.diag_indices(N)] += 1e-13
    A, B, C = scaled[: N - K, : N - K], scaled[: N - K, N - K :], scaled[N - K :, N - K :]
    both = np.column_stack([B, (scale * right)[: N - K]])
    X = both
    if N > K:
        _, X, info = lapack.dposv(A.T, both, lower=1)
        if info:
            return None
    M = np.triu(C) + np.triu(C, 1).T - B.T @ X[:, :K]
    rest = (scale * right)[N - K :] - B.T @ X[:, K]
    shared = _solve_weak(M, rest)
    out = np.concatenate([X[:, K] - X[:, :K] @ shared, shared]) * scale
    inverse = 1.0 / scale[N - K :]
    return out, M * inverse[:, None] * inverse[None, :]


def _solve_weak(M: Array, rest: Array) -> Array:
    """M⁻¹ rest for a symmetric M (K, K), directions without information left alone."""
    values, vectors = np.linalg.eigh(M)
    along = vectors.T @ rest
    return np.asarray(vectors @ np.where(values > LEAST_INFORMATION, along / np.maximum(values, LEAST_INFORMATION), 0.0))


def _covariance(information: Array, before: Array) -> Array:
    """Inverse of the information (K, K), which is not believed below a tiny share of what it was `before` (K,) the elimination."""
    scale = 1.0 / np.sqrt(np.maximum(before, 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    inverse = (vectors / np.maximum(values, LEAST_INFORMATION)) @ vectors.T
    return np.asarray(inverse * scale[:, None] * scale[None, :])


def _noise(squared: Array, squared_sigma: float, num_variables: int) -> float:
    """Standard deviation of an M-estimate's residual coordinate, such that covariance = noise² (Σ w JᵀJ)⁻¹.

    That is E[psi²] E[w] / E[psi']² for psi = w(r) r, with the degrees of freedom that the fit has used given back.
    """
    near = squared[squared < 9.0 * squared_sigma]
    if 2 * len(near) <= num_variables:
        return float("nan")
    w = (squared_sigma / (near + squared_sigma)) ** 2
    slope = w * (squared_sigma - near) / (squared_sigma + near)
    used = 2.0 * len(near) / (2.0 * len(near) - num_variables)
    return float(np.sqrt(used * 0.5 * np.mean(w**2 * near) * np.mean(w)) / max(np.mean(slope), 1e-3))


def _report(s: _State, costs: list[float], stopped: str) -> CalibrationReport:
    covariance, noise_px = s.covariance()
    deviations = np.sqrt(np.diag(covariance))
    refined = s.camera.with_model(s.model)
    corners = np.array([[u, v] for u in (0.0, refined.width - 1.0) for v in (0.0, refined.height - 1.0)])
    rays = refined.rays_from_ideal(corners)[:, :2]
    a, b = rays.T
    r2 = a * a + b * b
    fx, fy, zero, one = refined.fx, refined.fy, np.zeros(4), np.ones(4)
    by_model = np.array(
        [[a, zero], [zero, b], [one, zero], [zero, one], [fx * a * r2, fy * b * r2], [fx * a * r2**2, fy * b * r2**2],
         [2 * fx * a * b, fy * (r2 + 2 * b * b)], [fx * (r2 + 2 * a * a), 2 * fy * a * b]]
    )  # fmt: skip
    moved = np.linalg.norm(np.einsum("mk,mxc->kxc", s.basis, by_model), axis=1).max(axis=1) if len(s.free) else np.zeros(0)
    by_name = {name: float(value) for name, value in zip(s.free, deviations, strict=True)}
    by_name_px = {name: float(value) for name, value in zip(s.free, deviations * moved, strict=True)}
    return CalibrationReport(s.free, covariance, by_name, by_name_px, noise_px, np.array(costs), stopped == "settled", stopped)
