# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: bundle adjustment in which parameters of the one camera are free as well, and how well they are known.

A map holds ideal pixels, which depend on the calibration; what was measured are distorted pixels. So the residual
here is in distorted pixels, and the ideal ones are computed anew with the camera that is found.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.schur import LEAST_INFORMATION, ReducedSystem, Step, minimise
from vitamin3d.bundle_adjustment.variables import Progress, Variables, free_slots, sightings_of
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.reprojection import fill_model_derivatives
from vitamin3d.types import Array

PARAMETERS = ("f", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""`f` moves fx and fy together, their ratio kept."""
FIRST_DAMPING = 1e-5
SETTLED_DAMPING = 1e-6
SETTLED_DEVIATIONS = 0.1
"""The parameters are settled when an almost undamped step moves none of them by more than this share of its deviation."""


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
    basis, sightings = parameter_basis(free, aspect_of(camera)), sightings_of(problem, camera.distort(problem.obs_pixels))
    variables = Variables.of(problem, camera.model[None])
    noise_px = _noise(ReducedSystem(sightings, free_slots(problem), sigma_px).squared_errors(variables), problem, len(free), sigma_px)
    prior = np.array([(noise_px / priors[name]) ** 2 if priors and name in priors else 0.0 for name in free])
    system = ReducedSystem(sightings, free_slots(problem), sigma_px, basis, prior=prior)

    def is_settled(step: Step, damping: float) -> bool:
        deviations = noise_px * np.sqrt(np.diag(_covariance(step.information, step.information_alone)))
        in_deviations = float(np.max(np.abs(step.shared) / deviations, initial=0.0))
        return damping <= SETTLED_DAMPING and in_deviations <= SETTLED_DEVIATIONS

    variables, progress = minimise(system, variables, iterations, relative_gain, 1, is_settled, FIRST_DAMPING)
    refined = camera.with_model(variables.models[0])
    pixels = refined.undistort(camera.distort(problem.obs_pixels))
    solved = dataclasses.replace(variables.written_to(problem), obs_pixels=pixels)
    return solved, refined, _report(system, variables, problem, refined, tuple(free), sigma_px, progress)


def aspect_of(camera: Camera) -> float:
    """Focal length down over that to the right."""
    return camera.parameters["fy"] / camera.parameters["fx"]


def parameter_basis(free: Sequence[str], aspect: float) -> Array:
    """(8, K): how fx fy cx cy k1 k2 p1 p2 move with the free parameters; `f` moves fy by `aspect` times what it moves fx.

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
            basis[:2, k] = 1.0, aspect
        else:
            basis[PARAMETERS.index(name) - 1, k] = 1.0
    return basis


def _covariance(information: Array, before: Array) -> Array:
    """Inverse of the information (K, K), which is not believed below a tiny share of what it was `before` (K,) the elimination."""
    scale = 1.0 / np.sqrt(np.maximum(before, 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    inverse = (vectors / np.maximum(values, LEAST_INFORMATION)) @ vectors.T
    return np.asarray(inverse * scale[:, None] * scale[None, :])


def _noise(squared: Array, problem: BundleProblem, num_shared: int, sigma_px: float) -> float:
    """Standard deviation of an M-estimate's residual coordinate, such that covariance = noise² (Σ w JᵀJ)⁻¹.

    That is E[psi²] E[w] / E[psi']² for psi = w(r) r, with the degrees of freedom that the fit has used given back.
    """
    num_variables = 6 * problem.camera_is_free.sum() + 3 * (np.diff(problem.point_starts) >= 2).sum() + num_shared
    near = squared[squared < 9.0 * sigma_px**2]
    if 2 * len(near) <= num_variables:
        return float("nan")
    w = (sigma_px**2 / (near + sigma_px**2)) ** 2
    slope = w * (sigma_px**2 - near) / (sigma_px**2 + near)
    used = 2.0 * len(near) / (2.0 * len(near) - num_variables)
    return float(np.sqrt(used * 0.5 * np.mean(w**2 * near) * np.mean(w)) / max(np.mean(slope), 1e-3))


def _corner_motion(camera: Camera, basis: Array) -> Array:
    """(K,) how far a unit step of each parameter moves the farthest corner of the picture, pixels."""
    corners = np.array([[u, v] for u in (0.0, camera.width - 1.0) for v in (0.0, camera.height - 1.0)])
    J = np.empty((len(corners), 2, 8))
    fill_model_derivatives(camera.model[None], camera.rays_from_ideal(corners), J)
    return np.asarray(np.linalg.norm(J @ basis, axis=1).max(axis=0))


def _report(
    system: ReducedSystem, variables: Variables, problem: BundleProblem, camera: Camera, free: tuple[str, ...], sigma_px: float,
    progress: Progress,
) -> CalibrationReport:  # fmt: skip
    noise_px = _noise(system.squared_errors(variables), problem, len(free), sigma_px)
    step = system.step(variables, 0.0)
    covariance = noise_px**2 * _covariance(step.information, step.information_alone)
    deviations = np.sqrt(np.diag(covariance))
    by_name = {name: float(value) for name, value in zip(free, deviations, strict=True)}
    moved = deviations * _corner_motion(camera, system.basis)
    by_name_px = {name: float(value) for name, value in zip(free, moved, strict=True)}
    costs, stopped = np.array(progress.costs), progress.stopped
    return CalibrationReport(free, covariance, by_name, by_name_px, noise_px, costs, stopped == "settled", stopped)
