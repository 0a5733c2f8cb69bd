# SPDX-License-Identifier: Apache-2.0
"""One picture against its neighbours over planes of inverse depth: census cost, semi-global aggregation, winner.

The sweep (Collins 1996) compares census signatures (Zabih and Woodfill 1994), which exposure does not change; costs are
aggregated along rows and columns (Hirschmüller 2008).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.config import DensificationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array

HALF_WIDTH, HALF_HEIGHT = 4, 3
"""The census window is 9×7: 62 comparisons."""
UNKNOWN_COST = 24.0
"""Where no neighbour sees the point; wrong places cost about 31."""
GRADIENT_UNIT = 10.0
"""Grey levels between two pixels at which the penalty of a depth edge is half."""


@dataclass(frozen=True)
class SweptDepth:
    """What the sweep says of each pixel."""

    inverse_depth: Array
    """(H, W) float64, 0 = none."""
    distinctness: Array
    """(H, W) float32: the aggregated cost of the best other plane, not next to the winner, over the winner's."""
    cost: Array
    """(H, W) float32: census distance of the winner, 0–62."""


@inlined
def _ones(x):  # type: ignore[no-untyped-def]
    """Number of bits that are set in a uint64."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def _census(image, out):  # type: ignore[no-untyped-def]
    """A leading one, then whether each neighbour is darker than the centre; 0 where the window leaves the image or touches a zero."""
    for v in range(HALF_HEIGHT, image.shape[0] - HALF_HEIGHT):
        for u in range(HALF_WIDTH, image.shape[1] - HALF_WIDTH):
            center, bits, complete = image[v, u], np.uint64(1), True
            for j in range(-HALF_HEIGHT, HALF_HEIGHT + 1):
                for i in range(-HALF_WIDTH, HALF_WIDTH + 1):
                    value = image[v + j, u + i]
                    complete &= value != 0
                    if i != 0 or j != 0:
                        bits = (bits << np.uint64(1)) | np.uint64(value < center)
            out[v, u] = bits if complete else np.uint64(0)


def census(image: Array) -> Array:
    """Signatures (H, W) uint64 of an image (H, W) uint8; 0 = none. Grey level 0 means "no picture here"."""
    out = np.zeros(image.shape, np.uint64)
    _census(image, out)
    return out


@kernel
def _sweep(reference, sources, scale, shift_u, shift_v, center, cost):  # type: ignore[no-untyped-def]
    """Cost (H, W, D) float32: the mean of the two best of the sources' census distances, so that one may be hidden.

    The pixel (u, v) at plane d appears in source s at `(u - cx) scale[s, d] + shift_u[s, d]`, and v likewise.
    """
    height, width, planes = cost.shape
    for v in range(height):
        y = np.float32(v) - center[1]
        for u in range(width):
            x, signature = np.float32(u) - center[0], reference[v, u]
            for d in range(planes):
                best, second = np.float32(99.0), np.float32(99.0)
                if signature != np.uint64(0):
                    for s in range(sources.shape[0]):
                        a, b = int(x * scale[s, d] + shift_u[s, d]), int(y * scale[s, d] + shift_v[s, d])
                        if a < 0 or b < 0 or a >= width or b >= height:
                            continue
                        other = sources[s, b, a]
                        if other == np.uint64(0):
                            continue
                        distance = np.float32(_ones(signature ^ other))
                        second = min(second, max(best, distance))
                        best = min(best, distance)
                if best > 98.0:
                    cost[v, u, d] = np.float32(UNKNOWN_COST)
                elif second > 98.0:
                    cost[v, u, d] = best + np.float32(2.0)  # the best of one is higher than the best of two
                else:
                    cost[v, u, d] = np.float32(0.5) * (best + second)


@inlined
def _step(before, cost, after, lowest, small, large):  # type: ignore[no-untyped-def]
    """One pixel further along a path: `before`, `after` (D + 2,) with infinite ends; the lowest of `after`."""
    planes = cost.shape[0]
    for d in range(planes):
        best = before[d + 1]
        other = before[d] + small
        best = other if other < best else best
        other = before[d + 2] + small
        best = other if other < best else best
        other = lowest + large
        best = other if other < best else best
        after[d + 1] = cost[d] + best - lowest
    least = np.float32(1e9)
    for d in range(planes):
        least = after[d + 1] if after[d + 1] < least else least
    return least


@inlined
def _large(image, v, u, w, x, small, large):  # type: ignore[no-untyped-def]
    """The penalty of a depth edge between two pixels, lower where the image has an edge."""
    gradient = abs(np.float32(image[v, u]) - np.float32(image[w, x]))
    return max(large * np.float32(GRADIENT_UNIT) / (np.float32(GRADIENT_UNIT) + gradient), np.float32(1.5) * small)


@kernel
def _aggregate(cost, image, small, large, total):  # type: ignore[no-untyped-def]
    """Sums the costs of the four paths along rows and columns into `total` (H, W, D)."""
    height, width, planes = cost.shape
    lines = np.full((2, width, planes + 2), np.float32(1e6), np.float32)
    lowest = np.zeros(width, np.float32)
    total[:] = np.float32(0.0)
    for v in range(height):
        for direction in range(2):
            p = 0
            for k in range(width):
                u = k if direction == 0 else width - 1 - k
                if k == 0:
                    lines[p, 0, 1 : planes + 1] = np.float32(0.0)
                    least = np.float32(0.0)
                penalty = large if k == 0 else _large(image, v, u, v, u - 1 + 2 * direction, small, large)
                least = _step(lines[p, 0], cost[v, u], lines[1 - p, 0], least, small, penalty)
                p = 1 - p
                for d in range(planes):
                    total[v, u, d] += lines[p, 0, d + 1]
    for direction in range(2):
        p = 0
        lines[0, :, 1 : planes + 1] = np.float32(0.0)
        lowest[:] = np.float32(0.0)
        for k in range(height):
            v = k if direction == 0 else height - 1 - k
            for u in range(width):
                penalty = large if k == 0 else _large(image, v, u, v - 1 + 2 * direction, u, small, large)
                lowest[u] = _step(lines[p, u], cost[v, u], lines[1 - p, u], lowest[u], small, penalty)
                for d in range(planes):
                    total[v, u, d] += lines[1 - p, u, d + 1]
            p = 1 - p


@kernel
def _choose(total, cost, first, step, inverse_depth, distinctness, winner_cost):  # type: ignore[no-untyped-def]
    """The winner of each pixel, between planes by a parabola; none at the first and the last plane."""
    height, width, planes = total.shape
    for v in range(height):
        for u in range(width):
            k, least = 0, total[v, u, 0]
            for d in range(1, planes):
                if total[v, u, d] < least:
                    k, least = d, total[v, u, d]
            other = np.float32(1e9)
            for d in range(planes):
                if abs(d - k) > 2 and total[v, u, d] < other:
                    other = total[v, u, d]
            distinctness[v, u] = other / max(least, np.float32(1e-3))
            winner_cost[v, u] = cost[v, u, k]
            if 0 < k < planes - 1:
                left, right = total[v, u, k - 1], total[v, u, k + 1]
                bend = left + right - 2.0 * least
                inverse_depth[v, u] = first + step * (k + (0.5 * (left - right) / bend if bend > 0.0 else 0.0))


class PlaneSweep:
    """Sweeps pictures of one camera; keeps the memory of the cost volume between them."""

    def __init__(self, camera: Camera, config: DensificationConfig) -> None:
        self.camera, self.config = camera, config
        self._cost, self._total = (np.empty((camera.height, camera.width, config.planes), np.float32) for _ in range(2))

    def depths(self, image: Array, sources: list[Array], motions: Array, inverse_depths: Array) -> SweptDepth:
        """The inverse depth of each pixel.

        Args:
            image: (H, W) uint8, 0 = no picture.
            sources: pictures of the neighbours, turned into the orientation of this one (`turned`).
            motions: (S, 3), X_source = X + motion in that orientation.
            inverse_depths: (D,) planes, evenly spaced.
        """
        camera, signatures = self.camera, np.stack([census(source) for source in sources])
        with np.errstate(divide="ignore", over="ignore"):
            exact = 1.0 / np.maximum(1.0 + motions[:, 2:] * inverse_depths, 1e-6)
        moved_u = camera.fx * motions[:, :1] * inverse_depths * exact + camera.cx + 0.5
        moved_v = camera.fy * motions[:, 1:2] * inverse_depths * exact + camera.cy + 0.5
        scale, shift_u, shift_v = (np.clip(table, -1e9, 1e9).astype(np.float32) for table in (exact, moved_u, moved_v))
        _sweep(census(image), signatures, scale, shift_u, shift_v, np.array([camera.cx, camera.cy], np.float32), self._cost)
        config = self.config
        _aggregate(self._cost, image, np.float32(config.small_penalty), np.float32(config.edge_penalty), self._total)
        found, distinctness, cost = np.zeros(image.shape), np.zeros(image.shape, np.float32), np.zeros(image.shape, np.float32)
        step = inverse_depths[1] - inverse_depths[0]
        _choose(self._total, self._cost, inverse_depths[0], step, found, distinctness, cost)
        return SweptDepth(found, distinctness, cost)


def turned(image: Array, camera: Camera, R_source_reference: Array) -> Array:
    """A picture of the source as its camera would see it in the reference's orientation; 0 outside."""
    H = camera.K @ R_source_reference @ np.linalg.inv(camera.K)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(image, H, (camera.width, camera.height), flags=flags))
