# SPDX-License-Identifier: Apache-2.0
"""From which curvature on a maximum is of the scene: the floor follows the picture's noise, and sinks where there is little texture."""

from dataclasses import replace

import cv2
import numpy as np

from vitamin3d.config import CurvatureConfig, ExtremaConfig
from vitamin3d.types import Array

LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""A second derivative in both directions: 0 on planes and edges; white noise of deviation s comes out with 6 s (Immerkaer 1996)."""
BLOCK_PX = 32
QUIET_SHARE = 0.2
"""The noise is that of the quietest blocks of the picture: in the others it is texture."""


def noise_deviation(image: Array) -> float:
    """Standard deviation of the noise of a picture (H, W) uint8, grey levels."""
    rough = np.abs(cv2.filter2D(image, cv2.CV_32F, LAPLACIAN, borderType=cv2.BORDER_REFLECT))
    blocks = cv2.resize(rough, (max(1, image.shape[1] // BLOCK_PX), max(1, image.shape[0] // BLOCK_PX)), interpolation=cv2.INTER_AREA)
    return float(np.sqrt(np.pi / 2) / 6.0 * np.quantile(blocks, QUIET_SHARE))


def smoothing_for(noise: float, config: CurvatureConfig) -> CurvatureConfig:
    """The settings with the blur for pictures whose noise has this deviation, in steps of a tenth of a pixel."""
    wider = config.smoothing_sigma_px + config.smoothing_per_noise * max(0.0, noise - config.quiet_noise)
    sigma = round(min(max(config.smoothing_sigma_px, config.max_smoothing_sigma_px), wider), 1)
    return replace(config, smoothing_sigma_px=max(config.smoothing_sigma_px, sigma))


def lowest_floor(noise: float, smoothing_sigma_px: float, config: ExtremaConfig) -> float:
    """The curvature that noise of this deviation alone hardly reaches.

    Kappa is of the third degree in the grey levels and of the fourth in the derivatives; white noise itself is smoothed away with the
    blur's width.
    """
    return max(config.lowest_curvature, config.noise_curvature * noise**3 * (1.9 / max(0.5, smoothing_sigma_px)) ** 7)


def curvature_floor(strengths: Array, lowest: float, config: ExtremaConfig) -> float:
    """The floor for a picture whose maxima above `lowest` have the curvatures (E,), strongest first."""
    wanted = float(strengths[config.wanted - 1]) if len(strengths) >= config.wanted else lowest
    return max(lowest, min(config.min_curvature, wanted))
