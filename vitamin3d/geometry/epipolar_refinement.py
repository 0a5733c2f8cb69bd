# SPDX-License-Identifier: Apache-2.0
"""The motion of two views that fits all their pairs best: few degrees of parallax allow several, and RANSAC ends at any of them.

From translations in many directions the robust cost of the Sampson distances is minimised over the five parameters of the
motion; the least of the minima wins.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from vitamin3d.geometry.se3 import exp_so3, skew
from vitamin3d.types import Array

DIRECTIONS = np.array(list(product((-1.0, 0.0, 1.0), repeat=3))[14:])
"""(13, 3): of the 26 neighbours of a cube's middle one from each opposite pair, whose essential matrices are the same."""
SEARCH_PAIRS = 300
"""At most so many tell which minimum is the least; all of them refine it."""
ITERATIONS = 12
DIFFERENCE = 1e-6
"""Radians, for the derivatives."""
FIRST_DAMPING = 1e-3


def sampson_distances(matrix: Array, x_0: Array, x_1: Array) -> Array:
    """Signed first-order distances of paired points (N, 3) with z = 1 from x_1ᵀ matrix x_0 = 0, in the unit of the points.

    Args:
        matrix: (..., 3, 3) one or many; the essential one for rays, the fundamental one for pixels.

    Returns:
        (..., N).
    """
    lines_1, lines_0 = x_0 @ np.swapaxes(matrix, -1, -2), x_1 @ matrix
    squared = lines_1[..., 0] ** 2 + lines_1[..., 1] ** 2 + lines_0[..., 0] ** 2 + lines_0[..., 1] ** 2
    return np.asarray(np.einsum("ni,...ni->...n", x_1, lines_1) / np.sqrt(np.maximum(squared, 1e-24)))


def refine_essential(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> Array:
    """The essential matrix (3, 3) of least Geman–McClure cost (Eq. 3's) that is reached from a motion or from any direction.

    Args:
        R, t: rotation (3, 3) and translation (3,) of T_1_0 to begin with; the other directions begin with its rotation.
        rays_0, rays_1: (N, 3) paired, z = 1, N >= 5.
        sigma: scale of the cost, in units of the focal length.
    """
    motion = best_motion(R, t, rays_0, rays_1, sigma)
    return np.asarray(skew(motion.t) @ motion.R)


class Motion(NamedTuple):
    """Of a camera from view 0 to view 1, up to the length of its way."""

    R: Array
    """(3, 3) of T_1_0."""
    t: Array
    """(3,) of T_1_0, of length 1."""
    cost: float
    """Geman–McClure, sum over the pairs."""


def best_motion(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> Motion:
    """The motion of least cost; arguments as of `refine_essential`."""
    some, starts = slice(None, None, -(-len(rays_0) // SEARCH_PAIRS)), np.vstack([t, DIRECTIONS])
    rotations, translations, costs = _descended(np.repeat(R[None], len(starts), axis=0), starts, rays_0[some], rays_1[some], sigma)
    best = [int(np.argmin(costs))]
    rotations, translations, costs = _descended(rotations[best], translations[best], rays_0, rays_1, sigma)
    return Motion(rotations[0], translations[0], float(costs[0]))


def motion_cost(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> float:
    """The cost that `best_motion` lowers, of a motion with a translation (3,) of any length but 0."""
    return float((_residuals(R, t / np.linalg.norm(t), rays_0, rays_1, sigma) ** 2).sum())


def _descended(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> tuple[Array, Array, Array]:
    """Levenberg–Marquardt from each of many motions, R (S, 3, 3) and t (S, 3): R, t with |t| = 1, and the costs (S,)."""
    turns = np.stack([exp_so3(DIFFERENCE * axis) for axis in np.eye(3)])
    t = t / np.linalg.norm(t, axis=1, keepdims=True)
    residuals = _residuals(R, t, rays_0, rays_1, sigma)
    costs, damping = (residuals**2).sum(axis=1), np.full(len(R), FIRST_DAMPING)
    for _ in range(ITERATIONS):
        across = np.linalg.svd(t[:, None])[2][:, 1:]
        near_R = np.concatenate([turns @ R[:, None], np.repeat(R[:, None], 2, axis=1)], axis=1)
        near_t = np.concatenate([np.repeat(t[:, None], 3, axis=1), t[:, None] + DIFFERENCE * across], axis=1)
        J = (_residuals(near_R, near_t, rays_0, rays_1, sigma) - residuals[:, None]) / DIFFERENCE
        H, g = J @ np.swapaxes(J, 1, 2), J @ residuals[..., None]
        damped = H + damping[:, None, None] * H * np.eye(5) + 1e-9 * np.eye(5)
        step = -np.linalg.solve(damped, g)[..., 0]
        new_R = np.stack([exp_so3(omega) for omega in step[:, :3]]) @ R
        new_t = t + np.einsum("sk,ski->si", step[:, 3:], across)
        new_t /= np.linalg.norm(new_t, axis=1, keepdims=True)
        new = _residuals(new_R, new_t, rays_0, rays_1, sigma)
        new_costs = (new**2).sum(axis=1)
        better = new_costs < costs
        R, t = np.where(better[:, None, None], new_R, R), np.where(better[:, None], new_t, t)
        residuals = np.where(better[:, None], new, residuals)
        costs, damping = np.where(better, new_costs, costs), damping * np.where(better, 0.1, 10.0)
    return R, t, costs


def _residuals(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> Array:
    """(..., N) whose squares are the Geman–McClure cost, for motions R (..., 3, 3) and t (..., 3)."""
    E = np.cross(t[..., None], R, axis=-2)
    r = sampson_distances(E, rays_0, rays_1) / sigma
    return np.asarray(r / np.sqrt(1.0 + r * r))
