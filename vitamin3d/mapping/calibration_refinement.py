# SPDX-License-Identifier: Apache-2.0
"""The calibration refined while mapping: real ones are wrong by percents, and the map pays for it.

Each time the map has grown by a factor, the camera's parameters join an adjustment of the whole map. Tracks that a wrong
calibration contradicts are cut short, so that the first refinements see too little of the error: later ones correct them.
"""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem, points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.self_calibration import CalibrationReport, adjust_with_intrinsics, aspect_of, parameter_basis
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rolling_shutter import ideal_pixels, measured_pixels
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.readout_estimation import estimate_readout, frame_interval_s
from vitamin3d.mapping.window_selection import Window, build_problem, spread_over_map, store_solution, whole_map
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array

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
    _reads_at_once: bool = False

    @property
    def is_enabled(self) -> bool:
        return self.config.refine != "off"

    @property
    def wants_image_motion(self) -> bool:
        """Whether keyframes need the image's motion, from which the readout time comes; not once it is known to be none."""
        return self.is_enabled and self.config.readout and not self._reads_at_once

    def inherit(self, other: "CalibrationRefinement") -> None:
        """Knows what another map of the same camera found out about its shutter."""
        self._reads_at_once = other._reads_at_once

    def is_due(self, num_keyframes: int) -> bool:
        """Whether the map has grown enough since the last refinement."""
        return self.is_enabled and num_keyframes >= max(self.config.first_keyframes, self._next)

    def refine(self, sparse_map: SparseMap, camera: Camera) -> Camera:
        """The camera refined with the whole map, which moves along: poses, points and ideal pixels; or the same camera."""
        self._next = int(np.ceil(self.config.growth * sparse_map.num_keyframes))
        camera = self._refine_intrinsics(sparse_map, camera)
        return self._refine_readout(sparse_map, camera) if self.wants_image_motion and sparse_map.image_motions.any() else camera

    def _refine_intrinsics(self, sparse_map: SparseMap, camera: Camera) -> Camera:
        window = spread_over_map(sparse_map, self.config.max_keyframes)
        problem = build_problem(sparse_map, window)
        chosen = points_of_long_tracks(problem, self.config.points_per_keyframe)
        free = tuple(self.config.parameters.split())
        priors = {"f": self.config.prior_focal * camera.parameters["fx"], "k1": self.config.prior_distortion}
        solved, refined, report = adjust_with_intrinsics(
            select_points(problem, chosen), camera, free, self.config.sigma_px, self.config.iterations, priors=priors
        )
        deviations = {name: self.config.systematic_factor * value for name, value in report.deviations.items()}
        reason = self._doubt(deviations, refined, report)
        self.history.append(Refinement(sparse_map.num_keyframes, refined if not reason else camera, deviations, not reason, reason))
        if reason:
            return camera
        _change_camera(sparse_map, camera, refined, self.config, (window, solved))
        return refined

    def _refine_readout(self, sparse_map: SparseMap, camera: Camera) -> Camera:
        found, interval = estimate_readout(sparse_map, camera, self.config), frame_interval_s(sparse_map)
        deviation = self.config.readout_systematic_factor * found.deviation_s
        refined, reason = camera.with_readout(float(np.clip(found.readout_s, -interval, interval))), ""
        if not deviation <= self.config.max_readout_deviation * interval:
            reason = "the motion does not determine the readout time"
        elif abs(found.readout_s) > interval + deviation:
            reason = f"a readout of {1e3 * found.readout_s:.1f} ms is longer than the time between two frames"
        elif camera.readout_s == 0.0 and abs(found.readout_s) < self.config.significance * deviation:
            reason = "all rows were read at once"
            self._reads_at_once = deviation <= self.config.settled_readout_deviation * interval
        believed = camera if reason else refined
        self.history.append(Refinement(sparse_map.num_keyframes, believed, {"readout_s": deviation}, not reason, reason))
        if reason:
            return camera
        _change_camera(sparse_map, camera, refined, self.config)
        return refined

    def _doubt(self, deviations: dict[str, float], refined: Camera, report: CalibrationReport) -> str:
        """Why the refined camera is not believed; empty where it is."""
        if not np.isfinite(list(deviations.values())).all() or not np.isfinite(report.costs[-1]):
            return "the adjustment failed"
        fx, given_fx = refined.parameters["fx"], self.given.parameters["fx"]
        if abs(fx / given_fx - 1.0) > self.config.max_change:
            return f"a focal length of {fx:.1f} px is too far from the given one"
        if self.config.refine == "on":
            return ""
        focal = deviations.get("f", 0.0) / fx
        if focal > self.config.max_focal_deviation:
            return f"the motion does not determine the focal length (± {100.0 * focal:.1f} %)"
        if not self._was_refined() and self._distance(report, refined) < self.config.significance:
            return "the given calibration agrees with the pictures"
        return ""

    def _was_refined(self) -> bool:
        return any(refinement.accepted and "readout_s" not in refinement.deviations for refinement in self.history)

    def _distance(self, report: CalibrationReport, refined: Camera) -> float:
        """From the given calibration, all parameters together, in standard deviations (Mahalanobis)."""
        basis = parameter_basis(report.names, aspect_of(self.given))
        moved = np.linalg.pinv(basis) @ (refined.model - self.given.model)
        return float(np.sqrt(moved @ np.linalg.solve(report.covariance, moved))) / self.config.systematic_factor


def _change_camera(
    sparse_map: SparseMap, old: Camera, new: Camera, config: CalibrationConfig, solution: tuple[Window, BundleProblem] | None = None
) -> None:
    """Turns the map's ideal pixels into those of another camera, writes the `solution`, and moves all else to it."""
    for k, motion in enumerate(sparse_map.image_motions):
        rows = sparse_map.observations_of(k)
        sparse_map.obs_pixels[rows] = ideal_pixels(measured_pixels(sparse_map.obs_pixels[rows], motion, old), motion, new)
    sparse_map.remove_observations(np.flatnonzero(np.isnan(sparse_map.obs_pixels[:, 0])))
    is_free = np.zeros(sparse_map.num_keyframes, np.bool_)
    if solution is not None:
        is_free = _store_with_neighbours(sparse_map, *solution)
    window = whole_map(sparse_map)
    problem = dataclasses.replace(build_problem(sparse_map, window), camera_is_free=is_free)
    for sigma in POINT_SIGMAS:
        problem, _ = adjust_subspace(problem, new, sigma * config.sigma_px, POINT_SWEEPS)
    store_solution(sparse_map, window, problem)


def _store_with_neighbours(sparse_map: SparseMap, window: Window, solved: BundleProblem) -> Array:
    """Stores the solution of some keyframes; each other one moves with the last of them before it: which those are (K,)."""
    before = np.searchsorted(window.keyframes, np.arange(sparse_map.num_keyframes), side="right") - 1
    T_cam_before = sparse_map.T_cam_world @ inverse(sparse_map.T_cam_world[window.keyframes])[before]
    store_solution(sparse_map, window, solved)
    is_other = np.ones(sparse_map.num_keyframes, np.bool_)
    is_other[window.keyframes] = False
    sparse_map.T_cam_world[is_other] = (T_cam_before @ sparse_map.T_cam_world[window.keyframes][before])[is_other]
    return is_other
