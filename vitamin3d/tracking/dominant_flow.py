# SPDX-License-Identifier: Apache-2.0
"""Dominant flow: the affine motion of the whole image, from a few coarse matches (Sec. 2.2, Eq. 2–3)."""

from dataclasses import dataclass

import cv2
import numpy as np

from vitamin3d.config import DominantFlowConfig
from vitamin3d.image.corners import mutual_matches
from vitamin3d.types import Array, DominantFlow

PATCH_PX = 15
FAST_THRESHOLD = 5


@dataclass(frozen=True)
class CoarseFeatures:
    """Corners of the reduced image with their binary descriptors."""

    pixels: Array
    """(N, 2) float64, pixels of the full image."""
    descriptors: Array
    """(N, 32) uint8."""


def coarse_features(image: Array, config: DominantFlowConfig) -> CoarseFeatures:
    """Corners and (steered) BRIEF descriptors of a picture (H, W) uint8 at a sixth of its size."""
    scale = config.reduction
    size = (max(1, image.shape[1] // scale), max(1, image.shape[0] // scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    orb = cv2.ORB_create(  # type: ignore[attr-defined]
        config.max_features, nlevels=1, edgeThreshold=PATCH_PX // 2 + 1, patchSize=PATCH_PX, fastThreshold=FAST_THRESHOLD
    )
    keypoints, descriptors = orb.detectAndCompute(small, None)
    if descriptors is None:
        return CoarseFeatures(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))
    pixels = np.array([k.pt for k in keypoints], np.float64)
    step = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
    return CoarseFeatures((pixels + 0.5) * step - 0.5, descriptors)


def match_features(previous: CoarseFeatures, current: CoarseFeatures) -> tuple[Array, Array]:
    """Mutually best matches: pixels (N, 2) in the previous and (N, 2) in the current image."""
    i = mutual_matches(previous.descriptors, current.descriptors)
    return previous.pixels[i[:, 0]], current.pixels[i[:, 1]]


def fit_affine_flow(x: Array, y: Array, sigma: float, iterations: int) -> tuple[Array, Array, Array]:
    """Minimises Eq. 2, sum of rho(|y - (A x + b)|), by Gauss–Newton; Geman–McClure weights, scale annealed to sigma.

    Args:
        x: (N, 2) previous pixels, N >= 3.
        y: (N, 2) current pixels.
        sigma: scale of Eq. 3, pixels.
        iterations: of Gauss–Newton.

    Returns:
        A (2, 2), b (2,), residual norms (N,) in pixels.
    """
    center = x.mean(axis=0)
    basis = np.column_stack([x - center, np.ones(len(x))])
    theta = np.vstack([np.eye(2), np.median(y - x, axis=0) + center])
    squared = ((y - basis @ theta) ** 2).sum(axis=1)
    scale = max(sigma, 1.5 * float(np.sqrt(np.median(squared))))
    for _ in range(iterations):
        weights = (scale**2 / (squared + scale**2)) ** 2
        normal = basis.T @ (basis * weights[:, None]) + 1e-9 * np.eye(3)
        theta = theta + np.linalg.solve(normal, basis.T @ (weights[:, None] * (y - basis @ theta)))
        squared = ((y - basis @ theta) ** 2).sum(axis=1)
        scale = max(sigma, 0.7 * scale)
    A = theta[:2].T
    return A, theta[2] - A @ center, np.sqrt(squared)


def estimate_dominant_flow(
    previous: CoarseFeatures | None, current: CoarseFeatures, fallback: DominantFlow, config: DominantFlowConfig
) -> DominantFlow:
    """The dominant flow from the previous to the current image; `fallback` with ratio 0 where matching fails."""
    x, y = match_features(previous, current) if previous is not None else (np.zeros((0, 2)), np.zeros((0, 2)))
    failed = DominantFlow(fallback.A, fallback.b, 0.0)
    if len(x) < config.min_matches:
        return failed
    sigma = config.sigma_px * config.reduction
    A, b, residuals = fit_affine_flow(x, y, sigma, config.iterations)
    inlier_ratio = float((residuals < 2.0 * sigma).mean())
    plausible = 0.5 < np.linalg.det(A) < 2.0
    return DominantFlow(A, b, inlier_ratio) if plausible and inlier_ratio >= config.min_inlier_ratio else failed
