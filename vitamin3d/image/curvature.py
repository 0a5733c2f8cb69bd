# SPDX-License-Identifier: Apache-2.0
"""Curvature of the image (Eq. 1)."""

import cv2
import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import CurvatureConfig
from vitamin3d.types import Array

TAPS_PER_SIGMA = 3.0
"""Half the width of the Gaussian filter."""


@kernel
def _curvature(f, kappa):  # type: ignore[no-untyped-def]
    """Central differences inside, zero on the one-pixel border; f and kappa (H, W) float32."""
    height, width = f.shape
    half, quarter, two = np.float32(0.5), np.float32(0.25), np.float32(2.0)
    kappa[0, :] = 0.0
    kappa[height - 1, :] = 0.0
    for v in range(1, height - 1):
        kappa[v, 0] = 0.0
        kappa[v, width - 1] = 0.0
        for u in range(1, width - 1):
            f_x = half * (f[v, u + 1] - f[v, u - 1])
            f_y = half * (f[v + 1, u] - f[v - 1, u])
            f_xx = f[v, u + 1] - two * f[v, u] + f[v, u - 1]
            f_yy = f[v + 1, u] - two * f[v, u] + f[v - 1, u]
            f_xy = quarter * (f[v + 1, u + 1] - f[v + 1, u - 1] - f[v - 1, u + 1] + f[v - 1, u - 1])
            kappa[v, u] = f_y * f_y * f_xx - two * f_x * f_y * f_xy + f_x * f_x * f_yy  # Eq. 1


def smoothed(image: Array, config: CurvatureConfig) -> Array:
    """The picture (H, W) uint8 as float32 grey levels 0–255 after a Gaussian blur."""
    sigma = config.smoothing_sigma_px
    if sigma <= 0:
        return np.asarray(image, np.float32)
    taps = cv2.getGaussianKernel(2 * round(TAPS_PER_SIGMA * sigma) + 1, sigma, cv2.CV_32F)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REPLICATE))


def curvature(image: Array, config: CurvatureConfig) -> Array:
    """kappa (H, W) float32 of a picture (H, W) uint8, in grey levels³ per pixel⁴ (Eq. 1).

    Unchanged by a brightness offset; a contrast gain g multiplies it by g³. Signed: dark ridges and the outer side of
    bright corners are positive, and an 8-bit type would lose half of it.
    """
    return curvature_of(smoothed(image, config))


def curvature_of(f: Array) -> Array:
    """kappa (H, W) float32 of a blurred picture (H, W) float32 (Eq. 1)."""
    kappa = np.empty_like(f)
    _curvature(f, kappa)
    return kappa
