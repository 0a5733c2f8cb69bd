# SPDX-License-Identifier: Apache-2.0
"""Small pictures around pixels, and how alike two of them are."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.types import Array

PATCH_PX = 9


@kernel
def _cut_patches(image, pixels, radius, out):  # type: ignore[no-untyped-def]
    """Patches (N, P) uint8 around rounded pixels, clamped at the border."""
    height, width = image.shape
    for i in range(pixels.shape[0]):
        u, v = int(round(pixels[i, 0])), int(round(pixels[i, 1]))
        k = 0
        for n in range(v - radius, v + radius + 1):
            for m in range(u - radius, u + radius + 1):
                out[i, k] = image[min(max(n, 0), height - 1), min(max(m, 0), width - 1)]
                k += 1


@kernel
def _zncc(a, b, noise, out):  # type: ignore[no-untyped-def]
    """Zero-mean normalised cross-correlation of patches (N, P) row by row; 0 where one has no contrast.

    The variance of the noise is taken off those of the patches, half of each at most: it correlates with nothing.
    """
    for i in range(a.shape[0]):
        n = a.shape[1]
        sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            x, y = float(a[i, k]), float(b[i, k])
            sa, sb, saa, sbb, sab = sa + x, sb + y, saa + x * x, sbb + y * y, sab + x * y
        of_a, of_b, of_noise = saa - sa * sa / n, sbb - sb * sb / n, n * noise * noise
        variance = max(of_a - of_noise, 0.5 * of_a) * max(of_b - of_noise, 0.5 * of_b)
        out[i] = (sab - sa * sb / n) / np.sqrt(variance) if variance > 1e-6 else 0.0


def cut_patches(image: Array, pixels: Array) -> Array:
    """Patches (N, 81) uint8 of a picture (H, W) uint8 around distorted pixels (N, 2)."""
    out = np.empty((len(pixels), PATCH_PX * PATCH_PX), np.uint8)
    _cut_patches(image, np.ascontiguousarray(pixels), PATCH_PX // 2, out)
    return out


def patch_similarity(a: Array, b: Array, noise: float = 0.0) -> Array:
    """Zero-mean normalised cross-correlation (N,) of patches (N, P) uint8, in [-1, 1] but for noise of this deviation, grey levels."""
    out = np.empty(len(a))
    _zncc(a, b, noise, out)
    return out
