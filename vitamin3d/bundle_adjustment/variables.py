# SPDX-License-Identifier: Apache-2.0
"""The variables of an adjustment as the kernels take them, and what is reported of it in the end."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.observations import Sightings, Views, longest_first, squared_errors
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, BundleReport


@dataclass(frozen=True)
class Variables:
    """Poses, points and camera models; a step makes new ones."""

    R: Array
    """(C, 3, 3)."""
    t: Array
    """(C, 3)."""
    points: Array
    """(P, 3)."""
    models: Array
    """(1, 8) of all cameras or (C, 8) of each."""

    @staticmethod
    def of(problem: BundleProblem, models: Array) -> "Variables":
        R, t = (np.array(part, order="C") for part in (problem.T_cam_world[:, :3, :3], problem.T_cam_world[:, :3, 3]))
        return Variables(R, t, np.array(problem.points_world), models)

    def views(self, slot: Array) -> Views:
        return Views(self.R, self.t, slot, self.models)

    def written_to(self, problem: BundleProblem) -> BundleProblem:
        """The problem with these poses, rotations made orthogonal, and points; fixed cameras to the last bit as they were."""
        U, _, Vt = np.linalg.svd(self.R)
        poses, free = np.array(problem.T_cam_world), problem.camera_is_free
        poses[free, :3, :3], poses[free, :3, 3] = (U @ Vt)[free], self.t[free]
        return dataclasses.replace(problem, T_cam_world=poses, points_world=self.points)


def free_slots(problem: BundleProblem) -> Array:
    """(C,) int64: number among the free cameras, -1 where it is fixed."""
    return np.where(problem.camera_is_free, np.cumsum(problem.camera_is_free) - 1, -1)


def _camera_starts(problem: BundleProblem) -> Array:
    return np.searchsorted(problem.obs_camera, np.arange(len(problem.T_cam_world) + 1))


def sightings_of(problem: BundleProblem, pixels: Array | None = None) -> Sightings:
    """The observations in both orders; with other `pixels` (M, 2), in the problem's order, where they are given."""
    pixels, order = np.ascontiguousarray(problem.obs_pixels if pixels is None else pixels), problem.point_order
    by_length = np.empty(len(problem.points_world), np.int64)
    longest = longest_first(problem.point_starts, by_length)
    by_point = problem.point_starts, problem.obs_camera[order], pixels.take(order, axis=0), by_length
    return Sightings(*by_point, longest, _camera_starts(problem), np.ascontiguousarray(problem.obs_point), pixels)


def pinhole_model(camera: Camera) -> Array:
    """(1, 8): the camera as it sees ideal pixels."""
    return np.array([[*camera.intrinsics, 0.0, 0.0, 0.0, 0.0]])


def squared_errors_of(problem: BundleProblem, variables: Variables) -> Array:
    """|r|² (M,) of all observations of a problem in pixels², inf behind the camera."""
    out, views = np.empty(len(problem.obs_camera)), variables.views(free_slots(problem))
    pixels, points = (np.ascontiguousarray(a) for a in (problem.obs_pixels, variables.points))
    squared_errors(views, _camera_starts(problem), np.ascontiguousarray(problem.obs_point), pixels, points, out)
    return out


def squared_reprojection_errors(problem: BundleProblem, camera: Camera) -> Array:
    """|r|² (M,) of all observations, ideal pixels of `camera`, in pixels²; inf behind the camera."""
    return squared_errors_of(problem, Variables.of(problem, pinhole_model(camera)))


@dataclass
class Progress:
    """What is written down while a solver runs; rows of (gradient norm, largest pose step, largest point step)."""

    costs: list[float] = dataclasses.field(default_factory=list)
    steps: list[tuple[float, float, float]] = dataclasses.field(default_factory=list)
    stopped: str = "iterations"

    def report(self, errors: Array, sigma_px: float) -> BundleReport:
        """The report, given the squared errors (M,) at the end."""
        near = errors < (3.0 * sigma_px) ** 2
        rmse = float(np.sqrt(errors[near].mean())) if near.any() else float("nan")
        steps = np.array(self.steps, float).reshape(-1, 3)
        converged = self.stopped in ("gain", "settled", "gradient")
        return BundleReport(np.array(self.costs), converged, len(errors), rmse, self.stopped, *steps.T)
