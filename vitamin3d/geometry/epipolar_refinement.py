# SPDX-License-Identifier: Apache-2.0
"""The motion of two views that fits all their pairs best: few degrees of parallax allow several, and RANSAC ends at any of them.

From translations in many directions the robust cost of the Sampson distances is minimised over the five parameters of the
motion; the least of the minima wins.
"""

from itertools import product

import numpy as np
from scipy.optimize import least_squares

from vitamin3d.geometry.se3 import exp_so3, skew
from vitamin3d.types import Array

DIRECTIONS = np.array(list(product((-1.0, 0.0, 1.0), repeat=3))[14:])
"""(13, 3): of the 26 neighbours of a cube's middle one from each opposite pair, whose essential matrices are the same."""

SEARCH_PAIRS = 500
"""At most so many tell which minimum is the least; all of them refine it."""


def sampson_distances(E: Array, rays_0: Array, rays_1: Array) -> Array:
    """(N,) signed first-order distances of paired rays (N, 3) with z = 1 from x_1ᵀ E x_0 = 0, in units of the focal length."""
    lines_1, lines_0 = rays_0 @ E.T, rays_1 @ E
    norm = np.sqrt(lines_1[:, 0] ** 2 + lines_1[:, 1] ** 2 + lines_0[:, 0] ** 2 + lines_0[:, 1] ** 2)
    return np.asarray((rays_1 * lines_1).sum(axis=1) / np.maximum(norm, 1e-12))


def refine_essential(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> Array:
    """The essential matrix (3, 3) of least Geman–McClure cost (Eq. 3's) that is reached from a motion or from any direction.

    Args:
        R, t: rotation (3, 3) and translation (3,) of T_1_0 to begin with; the other directions begin with its rotation.
        rays_0, rays_1: (N, 3) paired, z = 1, N >= 5.
        sigma: scale of the cost, in units of the focal length.
    """
    some = slice(None, None, -(-len(rays_0) // SEARCH_PAIRS))
    minima = [_minimum(R, start, rays_0[some], rays_1[some], sigma) for start in (t, *DIRECTIONS)]
    _, R, t = min(minima, key=lambda minimum: minimum[0])
    _, R, t = _minimum(R, t, rays_0, rays_1, sigma)
    return skew(t) @ R


def _minimum(R: Array, t: Array, rays_0: Array, rays_1: Array, sigma: float) -> tuple[float, Array, Array]:
    """The cost, R and t, |t| = 1, at the minimum reached from one motion."""
    t = t / np.linalg.norm(t)
    across = np.linalg.svd(t[None])[2][1:].T

    def motion(step: Array) -> tuple[Array, Array]:
        moved = t + across @ step[3:]
        return exp_so3(step[:3]) @ R, moved / np.linalg.norm(moved)

    def residuals(step: Array) -> Array:
        turned, moved = motion(step)
        r = sampson_distances(skew(moved) @ turned, rays_0, rays_1) / sigma
        return np.asarray(r / np.sqrt(1.0 + r * r))

    found = least_squares(residuals, np.zeros(5), method="lm")
    return float(found.cost), *motion(found.x)
