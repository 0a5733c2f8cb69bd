# SPDX-License-Identifier: Apache-2.0
"""Depth maps as 16-bit PNG, and the one way that PNGs are written."""

from pathlib import Path

import cv2
import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.errors import OutputError
from vitamin3d.exporters.files import write_file
from vitamin3d.types import Array

MAX_COUNT = 65535


def write_depth_map(depth: Array, path: Path, counts_per_unit: float) -> None:
    """Depth (H, W) in map units as 16-bit PNG: count = depth * `counts_per_unit`; 0 = none or too far for 16 bits.

    Raises:
        OutputError: the file cannot be written.
    """
    write_png(counts_from_depth(depth, counts_per_unit), path)


def counts_from_depth(depth: Array, counts_per_unit: float) -> Array:
    """(H, W) uint16, rounded; what does not fit, NaN and below zero become 0."""
    depth, counts = np.ascontiguousarray(depth, np.float64), np.empty(np.shape(depth), np.uint16)
    _count(depth.ravel(), counts_per_unit, counts.ravel())
    return counts


@kernel
def _count(depth, counts_per_unit, counts):  # type: ignore[no-untyped-def]
    for n in range(depth.shape[0]):
        rounded = np.rint(depth[n] * counts_per_unit)
        counts[n] = np.uint16(rounded) if 0.0 <= rounded <= MAX_COUNT else np.uint16(0)


def write_png(image: Array, path: Path) -> None:
    """An image (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, complete or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    ordered = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    ok, buffer = cv2.imencode(".png", ordered)
    if not ok:
        raise OutputError(f"{path}: OpenCV could not encode the image {image.shape} {image.dtype} as PNG")
    write_file(path, [buffer.tobytes()])
