# SPDX-License-Identifier: Apache-2.0
"""Corners with binary descriptors, and which of two pictures' are the same: where neither flow nor map tells what went where."""

from typing import Any

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.types import Array

FAST_THRESHOLD = 7
WORDS = 4
"""64-bit words of a descriptor."""
PAIRS, FOURS, EIGHTS, ONES = (np.uint64(int(byte * 8, 16)) for byte in ("55", "33", "0f", "01"))
ONE, TWO, FOUR, TOP_BYTE = (np.uint64(n) for n in (1, 2, 4, 56))


def described_corners(image: Array, count: int) -> tuple[Array, Array]:
    """Corners (N, 2) in distorted pixels of a picture (H, W) uint8, and their binary descriptors (N, 32) uint8."""
    orb = cv2.ORB_create(count, fastThreshold=FAST_THRESHOLD)  # type: ignore[attr-defined]
    keypoints, descriptors = orb.detectAndCompute(image, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
    return np.array([k.pt for k in keypoints], np.float64), descriptors


def mutual_matches(a: Array, b: Array) -> Array:
    """Rows (M, 2) of descriptors a (N, 32) and b (K, 32) uint8 that are each other's nearest by Hamming distance; ties go to the first."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    forward, back = _nearest(*(np.ascontiguousarray(words).view(np.uint64) for words in (a, b)))
    rows = np.flatnonzero(back[forward] == np.arange(len(a)))
    return np.stack([rows, forward[rows]], axis=1)


@inlined
def _num_bits(x: Any) -> Any:
    x = x - ((x >> ONE) & PAIRS)
    x = (x & FOURS) + ((x >> TWO) & FOURS)
    return np.int64((((x + (x >> FOUR)) & EIGHTS) * ONES) >> TOP_BYTE)


@kernel
def _nearest(a: Array, b: Array) -> tuple[Array, Array]:
    """Of a (N, 4) and b (K, 4) uint64: the row of b nearest to each of a, (N,), and of a nearest to each of b, (K,)."""
    forward, back = np.zeros(len(a), np.int64), np.zeros(len(b), np.int64)
    least = np.full(len(b), 64 * WORDS + 1, np.int64)
    for i in range(len(a)):
        lowest = 64 * WORDS + 1
        for j in range(len(b)):
            distance = 0
            for w in range(WORDS):
                distance += _num_bits(a[i, w] ^ b[j, w])
            if distance < lowest:
                lowest, forward[i] = distance, j
            if distance < least[j]:
                least[j], back[j] = distance, i
    return forward, back
