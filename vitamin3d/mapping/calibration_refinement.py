# SPDX-License-Identifier: Apache-2.0
"""The calibration refined while mapping: real ones are wrong by percents, and the map pays for it.

Each time the map has grown by half, the camera's parameters join an adjustment of the whole map. Tracks that a wrong
calibration contradicts are cut short, so that the first refinements see too little of the error: later ones correct them.
"""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem, points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.self_calibration import CalibrationReport, adjust_with_intrinsics, parameter_basis
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.mapping.window_selection import build_problem, store_solution, whole_map

POINT_SWEEPS = 2
POINT_SIGMAS = (16.0, 4.0, 1.0)
"""The other points start far from where the refined camera sees them: scales of the kernel, in those of the refinement."""


@dataclass(frozen=True)
class Refinement:
    """One refinement of the calibration."""

    num_keyframes: int
    camera: Camera
    """The proposed camera; the one before it where the refinement was refused."""
    deviations: dict[str, float]
    """Standard deviation by free parameter, systematic errors included; pixels, k1 k2 p1 p2 without unit."""
    accepted: bool
    reason: str
    """Why it was refused; empty otherwise."""


@dataclass
class CalibrationRefinement:
    """Decides when the calibration is refined and whether the result is believed; remembers what became of it."""

    given: Camera
    config: CalibrationConfig
    history: list[Refinement] = field(default_factory=list)
    _next: int = 0

    @property
    def is_enabled(self) -> bool:
        return self.config.refine != "off"

    def is_due(self, num_keyframes: int) -> bool:
        """Whether the map has grown enough since the last refinement."""
        return self.is_enabled and num_keyframes >= max(self.config.first_keyframes, self._next)

    def refine(self, sparse_map: SparseMap, camera: Camera) -> Camera:
        """The camera refined with the whole map, which moves along: poses, points and ideal pixels; or the same camera."""
        self._next = int(np.ceil(self.config.growth * sparse_map.num_keyframes))
        problem = build_problem(sparse_map, whole_map(sparse_map))
        chosen = points_of_long_tracks(problem, self.config.points_per_keyframe)
        free = tuple(self.config.parameters.split())
        priors = {"f": self.config.prior_focal * camera.fx, "k1": self.config.prior_distortion}
        solved, refined, report = adjust_with_intrinsics(
            select_points(problem, chosen), camera, free, self.config.sigma_px, self.config.iterations, priors=priors
        )
        deviations = {name: self.config.systematic_factor * value for name, value in report.deviations.items()}
        reason = self._doubt(deviations, refined, report)
        self.history.append(Refinement(sparse_map.num_keyframes, refined if not reason else camera, deviations, not reason, reason))
        if reason:
            return camera
        _store(sparse_map, solved, camera, refined, self.config)
        return refined

    def _doubt(self, deviations: dict[str, float], refined: Camera, report: CalibrationReport) -> str:
        """Why the refined camera is not believed; empty where it is."""
        if not np.isfinite(list(deviations.values())).all() or not np.isfinite(report.costs[-1]):
            return "the adjustment failed"
        if abs(refined.fx / self.given.fx - 1.0) > self.config.max_change:
            return f"a focal length of {refined.fx:.1f} px is too far from the given one"
        if self.config.refine == "on":
            return ""
        focal = deviations.get("f", 0.0) / refined.fx
        if focal > self.config.max_focal_deviation:
            return f"the motion does not determine the focal length (± {100.0 * focal:.1f} %)"
        if not self._was_refined() and self._distance(report, refined) < self.config.significance:
            return "the given calibration agrees with the pictures"
        return ""

    def _was_refined(self) -> bool:
        return any(refinement.accepted for refinement in self.history)

    def _distance(self, report: CalibrationReport, refined: Camera) -> float:
        """From the given calibration, all parameters together, in standard deviations (Mahalanobis)."""
        basis = parameter_basis(report.names, self.given.fy / self.given.fx)
        moved = np.linalg.pinv(basis) @ (refined.model - self.given.model)
        return float(np.sqrt(moved @ np.linalg.solve(report.covariance, moved))) / self.config.systematic_factor


def _store(sparse_map: SparseMap, chosen: BundleProblem, old: Camera, new: Camera, config: CalibrationConfig) -> None:
    """Writes the chosen points' solution into the map, and moves the other points to it."""
    sparse_map.obs_pixels[:] = new.undistort(old.distort(sparse_map.obs_pixels))
    sparse_map.remove_observations(np.flatnonzero(np.isnan(sparse_map.obs_pixels[:, 0])))
    window = whole_map(sparse_map)
    store_solution(sparse_map, window, chosen)
    problem = build_problem(sparse_map, window)
    problem = dataclasses.replace(problem, camera_is_free=np.zeros(len(problem.T_cam_world), np.bool_))
    for sigma in POINT_SIGMAS:
        problem, _ = adjust_subspace(problem, new, sigma * config.sigma_px, POINT_SWEEPS)
    store_solution(sparse_map, window, problem)
