# SPDX-License-Identifier: Apache-2.0
"""The rotation between two sets of directions, robustly."""

import numpy as np

from vitamin3d.types import Array

ITERATIONS = 12


def fit_rotation(x: Array, y: Array, R_before: Array, sigma: float) -> Array:
    """R (3, 3) that turns unit directions x (N, 3) into y (N, 3): weighted Kabsch with Geman–McClure weights (Eq. 3's).

    Args:
        R_before: a first guess; the scale of the weights is annealed from what it leaves.
        sigma: the final scale, radians.
    """
    scale, R = np.inf, R_before
    for _ in range(ITERATIONS):
        squared = ((x @ R.T - y) ** 2).sum(axis=1)
        scale = max(sigma, min(0.6 * scale, 1.5 * float(np.sqrt(np.median(squared)))))
        weights = (scale**2 / (squared + scale**2)) ** 2
        U, _, Vt = np.linalg.svd((y * weights[:, None]).T @ x)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray(R)


def turned_by(x: Array, y: Array, R: Array) -> Array:
    """Angles (N,), radians, between R x and y, unit directions (N, 3); small ones."""
    return np.asarray(np.linalg.norm(x @ R.T - y, axis=1))
