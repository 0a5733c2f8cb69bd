# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter: the rows of a picture are read one after the other, while the camera moves on.

The motion of the image is smooth, so that a quadratic polynomial of the position says how fast each pixel moves. With the
readout time of the camera it carries every measured pixel to where it would be, had all rows been read with the middle one.
A *measured* pixel is a distorted one as it was found in the picture; ideal pixels are those of the middle row's moment.
"""

from dataclasses import replace

import cv2
import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.cholesky import solve_6x6
from vitamin3d.types import Array, Frame

TERMS = 6
NO_MOTION = np.zeros((TERMS, 2))
MOST_SAMPLES = 400
FIT_ITERATIONS = 6
LEAST_SCALE_PX = 0.5
INVERSION_STEPS = 4
CELL_PX = 8
"""The shifts of a whole picture are computed once per cell and interpolated."""


def _terms(pixels: Array, camera: Camera) -> Array:
    """(N, 6) terms 1 x y xx xy yy, x and y from the picture's middle in its width and height."""
    x, y = pixels[..., 0] / camera.width - 0.5, pixels[..., 1] / camera.height - 0.5
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


@kernel
def _fit(terms, motion, coefficients):  # type: ignore[no-untyped-def]
    """Fills `coefficients` (6, 2); False where the terms (N, 6) do not determine them."""
    weights, squared = np.ones(len(motion)), np.empty(len(motion))
    H, damped, g, delta = np.empty((1, TERMS, TERMS)), np.empty((1, TERMS, TERMS)), np.empty((2, TERMS)), np.empty(TERMS)
    for _ in range(FIT_ITERATIONS):
        H[:] = 0.0
        g[:] = 0.0
        for n in range(motion.shape[0]):
            for i in range(TERMS):
                weighted = weights[n] * terms[n, i]
                for c in range(2):
                    g[c, i] -= weighted * motion[n, c]
                for j in range(i, TERMS):
                    H[0, i, j] += weighted * terms[n, j]
        for i in range(TERMS):
            H[0, i, i] += 1e-9
        for c in range(2):
            damped[:] = H
            if not solve_6x6(damped, g[c], delta):
                return False
            coefficients[:, c] = delta
        for n in range(motion.shape[0]):
            squared[n] = 0.0
            for c in range(2):
                rest = motion[n, c]
                for i in range(TERMS):
                    rest -= terms[n, i] * coefficients[i, c]
                squared[n] += rest * rest
        scale = max(LEAST_SCALE_PX**2, np.median(squared))
        for n in range(motion.shape[0]):
            weights[n] = (scale / (squared[n] + scale)) ** 2
    return True


def fit_image_motion(previous: Array, current: Array, seconds: float, camera: Camera) -> Array:
    """Coefficients (6, 2) of the image's velocity, distorted pixels per second, by Gauss–Newton with Geman–McClure weights.

    Args:
        previous: (N, 2) distorted pixels.
        current: (N, 2) the same a while later.
        seconds: the while; where it is not positive, or with fewer than 60 pairs, the motion is taken as none.
    """
    sample = slice(None, None, max(1, len(previous) // MOST_SAMPLES))
    motion, coefficients = current[sample] - previous[sample], np.zeros((TERMS, 2))
    if seconds <= 0 or len(motion) < 10 * TERMS:
        return NO_MOTION
    return coefficients / seconds if _fit(_terms(current[sample], camera), motion, coefficients) else NO_MOTION


def row_shift(measured: Array, motion: Array, camera: Camera) -> Array:
    """(N, 2) pixels per second of readout: what measured pixels (N, 2) move between the middle row's moment and their own.

    Args:
        motion: (6, 2) of all, or (N, 6, 2) of each.
    """
    velocity = np.einsum("...k,...kc->...c", _terms(measured, camera), motion)
    return np.asarray(((measured[..., 1] + 0.5) / camera.height - 0.5)[..., None] * velocity)


def ideal_pixels(measured: Array, motion: Array, camera: Camera) -> Array:
    """Ideal pixels (N, 2), those of the middle row's moment, of measured ones (N, 2); NaN where the lens cannot be inverted."""
    if camera.readout_s == 0.0:
        return camera.undistort(measured)
    return camera.undistort(measured - camera.readout_s * row_shift(measured, motion, camera))


def measured_pixels(ideal: Array, motion: Array, camera: Camera) -> Array:
    """The inverse of `ideal_pixels`: where ideal pixels (N, 2) are found in the picture."""
    distorted = camera.distort(ideal)
    return distorted if camera.readout_s == 0.0 else _as_read(distorted, motion, camera)


def _as_read(distorted: Array, motion: Array, camera: Camera) -> Array:
    measured = distorted
    for _ in range(INVERSION_STEPS):
        measured = distorted + camera.readout_s * row_shift(measured, motion, camera)
    return np.asarray(measured)


def at_one_moment(frame: Frame, motion: Array, camera: Camera) -> Frame:
    """The frame as it would be, had all rows of its picture been read with the middle one; itself where nothing moves."""
    if camera.readout_s == 0.0 or not motion.any():
        return frame
    height, width = frame.image.shape
    coarse = np.meshgrid(*(np.arange(-(-n // CELL_PX)) * CELL_PX + 0.5 * (CELL_PX - 1.0) for n in (width, height)))
    at = np.stack(coarse, axis=-1)
    shift = cv2.resize((_as_read(at, motion, camera) - at).astype(np.float32), None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_LINEAR)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    maps = u + shift[:height, :width, 0], v + shift[:height, :width, 1]
    image = cv2.remap(frame.image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    color = None if frame.color is None else cv2.remap(frame.color, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, image=np.asarray(image), color=color)
