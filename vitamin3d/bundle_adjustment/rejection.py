# SPDX-License-Identifier: Apache-2.0
"""What of a problem cannot be used, by name, and the problem without it."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem, make_problem
from vitamin3d.bundle_adjustment.variables import Variables, squared_errors_of
from vitamin3d.types import Array

FARTHEST = 1e8
"""A point farther than this many median distances from the cameras' centre is at infinity."""


@dataclass(frozen=True)
class Rejection:
    """What was left out of an adjustment; indices into the problem as it was given."""

    not_finite: Array
    """Observations of or from something with a NaN or infinity."""
    duplicate: Array
    """Observations of a point that an earlier one of the same camera sees as well."""
    behind: Array
    """Observations whose point is behind the camera at the start."""
    seen_once: Array
    """Points left with fewer than two observations."""
    at_infinity: Array
    """Points too far away to have a depth."""
    unobserved_cameras: Array
    """Free cameras left with too few observations for a pose; they stay where they are."""

    def summary(self) -> str:
        """One line, empty where nothing was left out."""
        parts = ("not_finite", "duplicate", "behind", "seen_once", "at_infinity", "unobserved_cameras")
        counts = [(name.replace("_", " "), len(getattr(self, name))) for name in parts]
        return ", ".join(f"{count} {name}" for name, count in counts if count)


def reject(problem: BundleProblem, models: Array, min_camera_observations: int = 3) -> tuple[BundleProblem, Rejection]:
    """The problem without what no adjustment can use; all its cameras and points keep their numbers.

    A point that is left out keeps its place and has no observations; a camera without is held fixed.
    """
    point, camera = problem.obs_point, problem.obs_camera
    finite_points = np.asarray(np.isfinite(problem.points_world).all(axis=1))
    finite_cameras = np.asarray(np.isfinite(problem.T_cam_world).all(axis=(1, 2)))
    finite_cameras &= np.isfinite(models).all() if len(models) == 1 else np.isfinite(models).all(axis=1)
    not_finite = ~(finite_points[point] & finite_cameras[camera] & np.isfinite(problem.obs_pixels).all(axis=1))
    pair = camera.astype(np.int64) * len(problem.points_world) + point
    _, first = np.unique(np.where(not_finite, -1 - np.arange(len(pair)), pair), return_index=True)
    duplicate = ~not_finite
    duplicate[first] = False
    at_infinity = finite_points & (_distance(problem, finite_points, finite_cameras) > FARTHEST)
    keep = ~(not_finite | duplicate | at_infinity[point])
    behind, part = keep.copy(), with_observations(problem, keep)
    behind[keep] = np.isinf(squared_errors_of(part, Variables.of(part, models)))
    keep &= ~behind
    kept, weak = _until_stable(problem, keep, min_camera_observations)
    seen_once = (np.bincount(point, minlength=len(finite_points)) > 0) & finite_points & ~at_infinity
    seen_once &= np.bincount(point[kept], minlength=len(finite_points)) == 0
    masks = (not_finite, duplicate, behind, seen_once, at_infinity, weak & problem.camera_is_free)
    cleaned = with_observations(problem, kept, problem.camera_is_free & ~weak & finite_cameras)
    return cleaned, Rejection(*(np.flatnonzero(mask) for mask in masks))


def _distance(problem: BundleProblem, finite_points: Array, finite_cameras: Array) -> Array:
    """(P,) distance of each point from the cameras' middle in median distances; inf where it is not finite."""
    out = np.full(len(finite_points), np.inf)
    poses = problem.T_cam_world[finite_cameras]
    if finite_points.any() and len(poses):
        centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
        out[finite_points] = np.linalg.norm(problem.points_world[finite_points] - np.median(centers, axis=0), axis=1)
        out[finite_points] /= max(float(np.median(out[finite_points])), 1e-300)
    return out


def _until_stable(problem: BundleProblem, keep: Array, min_camera_observations: int) -> tuple[Array, Array]:
    """Observations kept (M,) when points need two of them and cameras some; and the cameras (C,) that are left without."""
    keep, weak = keep.copy(), np.zeros(len(problem.T_cam_world), np.bool_)
    while True:
        weak = np.bincount(problem.obs_camera[keep], minlength=len(weak)) < min_camera_observations
        alone = np.bincount(problem.obs_point[keep], minlength=len(problem.points_world)) < 2
        dropped = keep & (alone[problem.obs_point] | (weak & problem.camera_is_free)[problem.obs_camera])
        if not dropped.any():
            return keep, weak
        keep &= ~dropped


def with_observations(problem: BundleProblem, keep: Array, camera_is_free: Array | None = None) -> BundleProblem:
    """The problem with the observations of a mask (M,) bool, and all cameras and points."""
    rows = np.flatnonzero(keep)
    is_free = problem.camera_is_free if camera_is_free is None else camera_is_free
    part = make_problem(
        problem.T_cam_world, problem.points_world, problem.obs_camera[rows], problem.obs_point[rows], problem.obs_pixels[rows], is_free
    )
    return problem.renewed(dataclasses.replace(part, obs_rows=rows[part.obs_rows]))
