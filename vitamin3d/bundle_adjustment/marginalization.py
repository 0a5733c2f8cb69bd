# SPDX-License-Identifier: Apache-2.0
"""Variable elimination: cameras that leave a window, and the points they saw, become a quadratic prior on those that stay.

The prior is linearised once, at the poses of its making, and stays there: derivatives of one and the same place are
consistent, those taken anew at every step would invent information along the gauge.
"""

from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.normal_equations import NormalEquations, accumulate
from vitamin3d.bundle_adjustment.problem import BundleProblem, make_problem, select_points
from vitamin3d.bundle_adjustment.variables import Variables, sightings_of
from vitamin3d.geometry.se3 import inverse, log_se3, skew
from vitamin3d.types import Array


@dataclass(frozen=True)
class CameraPrior:
    """The cost xiᵀ H xi + 2 gᵀ xi of n cameras, xi their tangents [translation, rotation] from where it was made."""

    cameras: Array
    """(n,) numbers in the problem, ascending."""
    T_cam_world: Array
    """(n, 4, 4) where it was made."""
    information: Array
    """(6 n, 6 n) H."""
    gradient: Array
    """(6 n,) g."""

    def tangents(self, R: Array, t: Array) -> Array:
        """xi (n, 6) of the poses R (C, 3, 3), t (C, 3)."""
        poses = np.tile(np.eye(4), (len(self.cameras), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = R[self.cameras], t[self.cameras]
        return np.array([log_se3(T) for T in poses @ inverse(self.T_cam_world)]).reshape(-1, 6)

    def cost(self, R: Array, t: Array) -> float:
        """Its part of the cost at these poses, pixels²; zero where it was made."""
        xi = self.tangents(R, t).ravel()
        return float(xi @ self.information @ xi + 2.0 * self.gradient @ xi)

    def add_to(self, R: Array, t: Array, slot: Array, damping: float, reduced: Array, gradient: Array) -> None:
        """Adds its blocks to the upper triangle of a reduced system (6 F.., 6 F..) and to the gradient; fixed cameras have none."""
        xi = self.tangents(R, t)
        J = _by_step(xi)
        H, g = J.T @ self.information @ J, J.T @ (self.information @ xi.ravel() + self.gradient)
        H[np.diag_indices(len(H))] *= 1.0 + damping
        free = np.flatnonzero(slot[self.cameras] >= 0)
        rows, own = (6 * numbers[:, None] + np.arange(6) for numbers in (slot[self.cameras[free]], free))
        reduced[np.ix_(rows.ravel(), rows.ravel())] += H[np.ix_(own.ravel(), own.ravel())]
        gradient[rows.ravel()] += g[own.ravel()]


def _by_step(xi: Array) -> Array:
    """(6 n, 6 n) block-diagonal derivative of log(exp(delta) exp(xi)) by delta at 0: I - ad/2 + ad²/12 (to the fourth order)."""
    J = np.zeros((6 * len(xi), 6 * len(xi)))
    for n, (v, w) in enumerate(zip(xi[:, :3], xi[:, 3:], strict=True)):
        ad = np.block([[skew(w), skew(v)], [np.zeros((3, 3)), skew(w)]])
        J[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = np.eye(6) - 0.5 * ad + ad @ ad / 12.0
    return J


def marginalize(
    problem: BundleProblem, models: Array, gone: Array, sigma_px: float, prior: CameraPrior | None = None
) -> tuple[BundleProblem, CameraPrior]:
    """Takes cameras out of a problem; what they knew becomes a prior on the free cameras that share points with them.

    Args:
        models: (1, 8) of all cameras.
        gone: (C,) bool; these cameras and all points that they see are eliminated.
        prior: one from before; it is eliminated along.

    Returns:
        The problem of the other cameras, renumbered, with the other points; and the prior on its cameras.
    """
    seen = np.zeros(len(problem.points_world), np.bool_)
    seen[problem.obs_point[gone[problem.obs_camera]]] = True
    H, g, linked = _quadratic(select_points(problem, seen), models, gone, sigma_px, prior)
    rows = 6 * linked[:, None] + np.arange(6)
    out, stay = rows[gone[linked]].ravel(), rows[~gone[linked]].ravel()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[out], 1e-300))
    A = H[np.ix_(out, out)] * scale[:, None] * scale + 1e-12 * np.eye(len(out))
    lifted = np.linalg.solve(A, scale[:, None] * np.column_stack([H[np.ix_(out, stay)], g[out]]))
    cross = scale[:, None] * H[np.ix_(out, stay)]
    information, gradient = H[np.ix_(stay, stay)] - cross.T @ lifted[:, :-1], g[stay] - cross.T @ lifted[:, -1]
    numbers = np.cumsum(~gone) - 1
    kept = linked[~gone[linked]]
    made_at = problem.T_cam_world[kept]
    return _without(problem, gone, seen), CameraPrior(numbers[kept], made_at, 0.5 * (information + information.T), gradient)


def _quadratic(part: BundleProblem, models: Array, gone: Array, sigma_px: float, prior: CameraPrior | None) -> tuple[Array, Array, Array]:
    """H (6 C, 6 C) and g (6 C,) of the part's cost with its points eliminated, and the free cameras (n,) that take part."""
    C = len(part.T_cam_world)
    linked = part.camera_is_free & (np.bincount(part.obs_camera, minlength=C) > 0)
    if prior is not None:
        linked[prior.cameras[part.camera_is_free[prior.cameras]]] = True
    linked |= gone & part.camera_is_free
    slot = np.where(part.camera_is_free, np.arange(C), -1)
    variables, e = Variables.of(part, models), NormalEquations.zeros(C, 6, 0, len(part.points_world))
    accumulate(variables.views(slot), sightings_of(part), variables.points, np.zeros((8, 0)), 1.0 / sigma_px**2, 0.0, 0.0, e)
    rows = 6 * np.arange(C)[:, None] + np.arange(6)
    e.reduced[rows[:, :, None], rows[:, None, :]] += e.H_cameras
    g = e.gradient - e.lifted
    if prior is not None:
        H_prior, g_prior = np.zeros_like(e.reduced), np.zeros_like(g)
        prior.add_to(variables.R, variables.t, slot, 0.0, H_prior, g_prior)
        e.reduced[:], g = e.reduced + np.triu(H_prior), g + g_prior
    return np.triu(e.reduced) + np.triu(e.reduced, 1).T, g, np.flatnonzero(linked)


def _without(problem: BundleProblem, gone: Array, seen: Array) -> BundleProblem:
    """The problem of the cameras and points that stay."""
    part = select_points(problem, ~seen)
    numbers = np.cumsum(~gone) - 1
    kept = make_problem(
        part.T_cam_world[~gone], part.points_world, numbers[part.obs_camera], part.obs_point, part.obs_pixels, part.camera_is_free[~gone]
    )
    return part.renewed(kept)
