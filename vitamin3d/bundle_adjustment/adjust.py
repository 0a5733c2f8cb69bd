# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment for any problem, by any of the solvers; all minimise the same objective with the same derivatives.

    problem = make_problem(T_cam_world, points, obs_camera, obs_point, obs_pixels)
    adjusted = adjust(problem, camera.model[None], AdjustmentSettings(free=("f", "k1")))

The objective is the sum of rho(r) over the observations (Eq. 6), r the reprojection error in measured pixels, rho the
Geman–McClure kernel; its scale may start wide and narrow in stages.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem, points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.rejection import Rejection, reject
from vitamin3d.bundle_adjustment.schur import ReducedSystem, adjust_accelerated, adjust_schur, minimise
from vitamin3d.bundle_adjustment.self_calibration import parameter_basis
from vitamin3d.bundle_adjustment.subspace import adjust_by_inner_sweeps, adjust_subspace, step_until, sweep_points, sweep_until
from vitamin3d.bundle_adjustment.variables import Progress, Variables, free_slots, pinhole_model, sightings_of
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, BundleReport

SOLVERS: dict[str, Callable[[BundleProblem, Camera, float, int, float], tuple[BundleProblem, BundleReport]]] = {
    "subspace": adjust_subspace,
    "subspace-inner": adjust_by_inner_sweeps,
    "subspace-accelerated": adjust_accelerated,
    "schur": adjust_schur,
}
"""The tracker's way in: problem in ideal pixels, camera, sigma_px, the most iterations, the relative gain that ends them."""


@dataclass(frozen=True)
class AdjustmentSettings:
    """How a problem is adjusted."""

    solver: str = "subspace-accelerated"
    """`subspace` (Eq. 11–12), `subspace-inner` (several sweeps with the same derivatives), `subspace-accelerated` (all cameras
    together, the points eliminated and then swept), `schur`."""
    sigma_px: float = 2.0
    """Scale of the robust kernel; infinite: plain least squares."""
    first_sigma_px: float = 0.0
    """Where it starts, halved from stage to stage; 0: at sigma_px."""
    iterations: int = 50
    """In each stage."""
    relative_gain: float = 1e-6
    free: tuple[str, ...] = ()
    """Parameters of the camera that are variables too: f (or fx fy) cx cy k1 k2 p1 p2; only with the two latter."""
    own: bool = False
    """Whether each camera has these parameters for itself; else all share them."""
    gauge: str = "given"
    """`given` (the problem says which cameras are fixed), `first` (the first camera is), `free` (none is; damping holds it)."""


@dataclass(frozen=True)
class Adjusted:
    """The result of an adjustment."""

    problem: BundleProblem
    """All cameras and points of the given one; what was rejected is as it was."""
    models: Array
    """(1, 8) or (C, 8) fx fy cx cy k1 k2 p1 p2."""
    report: BundleReport
    """Its costs are those of the last stage."""
    rejection: Rejection


def adjust(problem: BundleProblem, models: Array, settings: AdjustmentSettings, prior: CameraPrior | None = None) -> Adjusted:
    """Adjusts cameras, points and, if asked for, camera parameters; what cannot be used is left out, by name.

    Args:
        problem: `obs_pixels` as measured, which is distorted where the models are.
        models: (1, 8) of all cameras or (C, 8) of each: fx fy cx cy k1 k2 p1 p2.
        prior: of cameras that were marginalised; not with `subspace` or `subspace-inner`.

    Raises:
        InputError: a setting that does not exist or go with the others.
    """
    _check(settings, models, prior)
    models = np.array(models, np.float64)
    if settings.gauge != "given":
        is_free = np.arange(len(problem.T_cam_world)) >= (settings.gauge == "first")
        problem = dataclasses.replace(problem, camera_is_free=is_free)
    usable, rejection = reject(problem, models)
    safe = np.where(np.isfinite(models), models, 1.0)
    start = dataclasses.replace(usable, points_world=_safe_points(usable), T_cam_world=_safe_poses(usable))
    variables, report = _run(start, Variables.of(start, safe), settings, prior)
    return Adjusted(_restored(problem, usable, variables), np.where(np.isfinite(models), variables.models, models), report, rejection)


def _run(
    problem: BundleProblem, variables: Variables, settings: AdjustmentSettings, prior: CameraPrior | None
) -> tuple[Variables, BundleReport]:
    sightings, slot = sightings_of(problem), free_slots(problem)
    basis = parameter_basis(settings.free, float(np.mean(variables.models[:, 1] / variables.models[:, 0])))
    system = ReducedSystem(sightings, slot, settings.sigma_px, basis, settings.own)
    system.camera_prior = prior
    steps: list[tuple[float, float, float]] = []
    progress = Progress()
    for sigma in _scales(settings):
        system.inverse_squared_sigma = 1.0 / sigma**2
        if settings.solver == "subspace":
            progress = sweep_until(problem, variables, 1.0 / sigma**2, settings.iterations, settings.relative_gain)
        elif settings.solver == "subspace-inner":
            variables, progress = step_until(problem, variables, 1.0 / sigma**2, settings.iterations, settings.relative_gain)
        else:
            sweeps = int(settings.solver == "subspace-accelerated")
            variables, progress = minimise(system, variables, settings.iterations, settings.relative_gain, sweeps)
        steps += progress.steps
    progress.steps = steps
    return variables, progress.report(system.squared_errors(variables), settings.sigma_px)


def _scales(settings: AdjustmentSettings) -> list[float]:
    scales = [settings.sigma_px]
    while np.isfinite(scales[0]) and 2.0 * scales[0] <= settings.first_sigma_px:
        scales.insert(0, 2.0 * scales[0])
    return scales


def _check(settings: AdjustmentSettings, models: Array, prior: CameraPrior | None) -> None:
    if settings.solver not in SOLVERS:
        raise InputError(f"no solver is called {settings.solver!r}; there are {', '.join(SOLVERS)}")
    if settings.gauge not in ("given", "first", "free"):
        raise InputError(f"no gauge is called {settings.gauge!r}; there are given, first, free")
    if settings.solver in ("subspace", "subspace-inner") and (settings.free or prior is not None):
        raise InputError(f"the solver {settings.solver!r} has blocks for cameras and points only; take 'subspace-accelerated'")
    if settings.free and settings.own == (len(models) == 1):
        raise InputError("parameters that each camera owns need a model for each camera, shared ones a single model")
    if not settings.sigma_px > 0.0:
        raise InputError(f"sigma_px must be positive, not {settings.sigma_px}")


def _safe_points(problem: BundleProblem) -> Array:
    return np.where(np.isfinite(problem.points_world), problem.points_world, 0.0)


def _safe_poses(problem: BundleProblem) -> Array:
    usable = np.asarray(np.isfinite(problem.T_cam_world).all(axis=(1, 2)))
    return np.where(usable[:, None, None], problem.T_cam_world, np.eye(4))


def _restored(problem: BundleProblem, usable: BundleProblem, variables: Variables) -> BundleProblem:
    """The given problem with the solution, and what was left out as it was."""
    solved = variables.written_to(dataclasses.replace(usable, T_cam_world=_safe_poses(usable)))
    moved = np.diff(usable.point_starts) > 0
    points = np.where(moved[:, None], solved.points_world, problem.points_world)
    poses = np.where(usable.camera_is_free[:, None, None], solved.T_cam_world, problem.T_cam_world)
    return dataclasses.replace(problem, T_cam_world=poses, points_world=points)


def adjust_bundle(
    problem: BundleProblem, camera: Camera, config: BundleAdjustmentConfig, prior: CameraPrior | None = None
) -> tuple[BundleProblem, BundleReport]:
    """The window's adjustment at a keyframe, by the solver that the settings name; a prior needs one that eliminates points."""

    def solve(part: BundleProblem) -> tuple[BundleProblem, BundleReport]:
        if prior is not None:
            solver = adjust_schur if config.keyframe_solver == "schur" else adjust_accelerated
            return solver(part, camera, config.sigma_px, config.keyframe_iterations, config.relative_gain, prior)
        return SOLVERS[config.keyframe_solver](part, camera, config.sigma_px, config.keyframe_iterations, config.relative_gain)

    return adjust_by_long_tracks(problem, camera, config.sigma_px, config.points_per_keyframe, solve)


def adjust_by_long_tracks(
    problem: BundleProblem,
    camera: Camera,
    sigma_px: float,
    per_camera: int,
    solve: Callable[[BundleProblem], tuple[BundleProblem, BundleReport]],
) -> tuple[BundleProblem, BundleReport]:
    """Cameras and the points that they see longest by `solve`, about `per_camera` of each; then a sweep over all points (Eq. 12).

    With per_camera = 0 all points take part in `solve`. The report is that of `solve`.
    """
    if not per_camera:
        return solve(problem)
    chosen = points_of_long_tracks(problem, per_camera)
    part, report = solve(select_points(problem, chosen))
    points = np.array(problem.points_world)
    points[chosen] = part.points_world
    placed = dataclasses.replace(problem, T_cam_world=part.T_cam_world, points_world=points)
    variables, sightings = Variables.of(placed, pinhole_model(camera)), sightings_of(problem)
    sweep_points(variables.views(free_slots(problem)), sightings, variables.points, 1.0 / sigma_px**2)
    return dataclasses.replace(placed, points_world=variables.points), report
