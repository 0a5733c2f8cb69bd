# SPDX-License-Identifier: Apache-2.0
"""How far a maximum of the curvature stands above the picture's noise; not in the paper.

The curvature is a product, g² b: the squared gradient times the bend of the picture along its level line. Where one of the two is
noise the product may still be large, and the maximum goes with the noise, not with the scene.
"""

import cv2
import numpy as np

from vitamin3d.config import ExtremaConfig
from vitamin3d.image.noise_floor import QUIET_SHARE
from vitamin3d.types import Array

BLOCK_PX = 16
GREYS_PER_BIN, MIN_BLOCKS = 12, 12
"""Noise depends on the grey level: so many levels are looked at together, where there are so many blocks of them."""
LAPLACIAN_TO_BEND = np.sqrt(3.0 / 8.0)
"""Deviation of one second derivative over that of their sum, for white noise after a Gaussian blur."""
BEND_TO_GRADIENT = np.sqrt(4.0 / 3.0)
"""Deviation of a first derivative, over the blur's sigma times that of a second one."""


def bend_noise(f: Array) -> Array:
    """(256,) deviation of a second derivative that is noise, by grey level, of a smoothed picture (H, W) float32.

    That of the quietest blocks: in the others it is texture.
    """
    rough = np.abs(cv2.Laplacian(f, cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REFLECT))
    size = max(1, f.shape[1] // BLOCK_PX), max(1, f.shape[0] // BLOCK_PX)
    blocks, greys = (cv2.resize(x, size, interpolation=cv2.INTER_AREA).ravel() for x in (rough, f))
    bins = greys.astype(np.int64) // GREYS_PER_BIN
    known = [b for b in np.unique(bins) if (bins == b).sum() >= MIN_BLOCKS]
    quiet = [np.quantile(blocks[bins == b], QUIET_SHARE) for b in known] or [np.quantile(blocks, QUIET_SHARE)]
    centres = GREYS_PER_BIN * (np.array(known or [0]) + 0.5)
    return np.asarray(np.sqrt(np.pi / 2.0) * LAPLACIAN_TO_BEND * np.interp(np.arange(256), centres, quiet))


def significance(f: Array, kappa: Array, extrema: Array, sigma_px: float) -> Array:
    """(E,) deviations of the noise: the lesser of bend and gradient at extrema (E, 2) of kappa (H, W).

    Args:
        f: the picture (H, W) float32, grey levels, blurred with `sigma_px`.
    """
    u, v = extrema[:, 0], extrema[:, 1]
    gradient = 0.5 * np.hypot(f[v, u + 1] - f[v, u - 1], f[v + 1, u] - f[v - 1, u])
    noise = np.maximum(1e-3, bend_noise(f)[np.clip(f[v, u], 0, 255).astype(np.int64)])
    bend = kappa[v, u] / np.maximum(1e-6, gradient**2)
    return np.asarray(np.minimum(bend, gradient / (BEND_TO_GRADIENT * max(0.5, sigma_px))) / noise)


def is_significant(values: Array, config: ExtremaConfig) -> Array:
    """(E,) bool: which extrema of these significances become tracks; of few, the less certain ones too."""
    count = max(config.significant_wanted, int(config.significant_share * len(values)))
    if len(values) <= count:
        return np.ones(len(values), np.bool_)
    wanted = np.sort(values)[len(values) - count] if count else np.inf
    return np.asarray(values >= min(config.significance, wanted))
