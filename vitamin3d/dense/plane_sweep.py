# SPDX-License-Identifier: Apache-2.0
"""One picture against its neighbours over planes of inverse depth: census cost, semi-global aggregation, winner.

The sweep (Collins 1996) compares census signatures (Zabih and Woodfill 1994), which exposure does not change; costs are
aggregated along rows and columns (Hirschmüller 2008).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import WIDE, counting_i16, least, lesser, load_i16, splat_i16, store, where_below
from vitamin3d.config import DensificationConfig
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array

HALF_WIDTH, HALF_HEIGHT = 4, 3
"""The census window is 9×7: 62 comparisons."""
UNKNOWN_COST = 24.0
"""Where no neighbour sees the point; wrong places cost about 31."""
NOT_SEEN = 99
"""More than any distance."""
INFINITE, FILLING = 30_000, 5000
"""Half bits: more than any cost of a path, of four of them; of planes that only fill up the sixteen."""
MAX_PENALTY = 2000.0
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
    """A leading one, then whether each pixel is darker than the centre; 0 where the window leaves the image or touches a zero.

    A row at a time and eight comparisons per byte: loops that LLVM vectorises."""
    width = image.shape[1] - 2 * HALF_WIDTH
    parts, lowest = np.empty((8, width), np.uint8), np.empty(width, np.uint8)
    for v in range(HALF_HEIGHT, image.shape[0] - HALF_HEIGHT):
        center, count = image[v, HALF_WIDTH : HALF_WIDTH + width], 1
        parts[:] = np.uint8(1)
        lowest[:] = np.uint8(255)
        for j in range(-HALF_HEIGHT, HALF_HEIGHT + 1):
            for i in range(2 * HALF_WIDTH + 1):
                part, row = parts[count // 8], image[v + j, i : i + width]
                for u in range(width):
                    part[u] = np.uint8((part[u] << 1) | (row[u] < center[u]))
                    lowest[u] = min(lowest[u], row[u])
                count += 1
        for u in range(width):
            bits = np.uint64(0)
            for k in range(8):
                bits |= np.uint64(parts[k, u]) << np.uint64(56 - 8 * k)
            out[v, HALF_WIDTH + u] = bits if lowest[u] != 0 else np.uint64(0)


def census(image: Array) -> Array:
    """Signatures (H, W) uint64 of an image (H, W) uint8; 0 = none. Grey level 0 means "no picture here"."""
    out = np.zeros(image.shape, np.uint64)
    _census(image, out)
    return out


@kernel
def _sweep(reference, sources, columns, rows, cost):  # type: ignore[no-untyped-def]
    """Cost (H, W, >= D) uint8, half bits: the mean of the two best of the sources' census distances, so that one may be hidden.

    The pixel (u, v) at plane d appears in source s at column `columns[s, d, u]` and row `rows[s, d, v]`; the last column and
    row of `sources` (S, H + 1, W + 1) are zero, for what lies outside.
    """
    height, width, planes = cost.shape[0], cost.shape[1], columns.shape[1]
    best, second, distance = np.empty((planes, width), np.uint8), np.empty((planes, width), np.uint8), np.empty(width, np.uint8)
    for v in range(height):
        signatures = reference[v]
        best[:] = NOT_SEEN
        second[:] = NOT_SEEN
        for s in range(sources.shape[0]):
            for d in range(planes):
                if rows[s, d, v] == height:
                    continue
                others, column = sources[s, rows[s, d, v]], columns[s, d]
                for u in range(width):
                    other = others[column[u]]
                    bits = np.uint8(_ones(signatures[u] ^ other))
                    distance[u] = bits if other != np.uint64(0) else np.uint8(NOT_SEEN)
                one, two = best[d], second[d]
                for u in range(width):
                    two[u] = min(two[u], max(one[u], distance[u]))
                    one[u] = min(one[u], distance[u])
        for d in range(planes):
            one, two = best[d], second[d]
            for u in range(width):  # twice the mean; the best of one is higher than the best of two
                doubled = np.uint8(2 * one[u] + 4) if two[u] == NOT_SEEN else np.uint8(one[u] + two[u])
                one[u] = np.uint8(2 * UNKNOWN_COST) if one[u] == NOT_SEEN or signatures[u] == np.uint64(0) else doubled
        for u in range(width):
            for d in range(planes):
                cost[v, u, d] = best[d, u]


@inlined
def _step(lines, before, cost, at, ceiling, lowest, small, large, total, after):  # type: ignore[no-untyped-def]
    """One pixel further along a path, sixteen planes at a time; adds its costs to `total` and returns the lowest of them.

    `before` and `after` are where the pixels' costs lie in `lines`, between two infinite ones, `at` where in `cost` and `total`.
    """
    smallest = splat_i16(INFINITE)
    for d in range(0, ceiling.shape[0], WIDE):
        beside = lesser(load_i16(lines, before + d - 1), load_i16(lines, before + d + 1)) + small
        best = lesser(lesser(load_i16(lines, before + d), beside), lowest + large)
        value = load_i16(cost, at + d) + best - lowest + load_i16(ceiling, d)
        store(lines, after + d, value)
        store(total, at + d, load_i16(total, at + d) + value)
        smallest = lesser(smallest, value)
    return least(smallest)


@inlined
def _difference(image, v, u, w, x):  # type: ignore[no-untyped-def]
    return abs(np.int64(image[v, u]) - np.int64(image[w, x]))


@kernel
def _aggregate(cost, image, small, penalties, ceiling, total):  # type: ignore[no-untyped-def]
    """Sums the costs of the four paths along rows and columns into `total` (H, W, P); `cost` (H, W, P), half bits.

    `penalties` (256,) is what a larger step costs between pixels of such different grey levels, `ceiling` (P,) 0, and a lot for
    planes that only fill up the sixteen.
    """
    height, width, planes = cost.shape
    stride = planes + 2
    lines = np.full(4 * width * stride, INFINITE, np.int16)
    lowest = np.zeros(width, np.int64)
    total[:] = 0
    for v in range(height):
        left, right = np.int64(0), np.int64(0)
        lines[: 4 * stride] = INFINITE
        lines[1 : 1 + planes] = ceiling
        lines[2 * stride + 1 : 2 * stride + 1 + planes] = ceiling
        p = 0
        for k in range(width):
            u, x = k, width - 1 - k
            one = penalties[_difference(image, v, u, v, max(u - 1, 0))]
            other = penalties[_difference(image, v, x, v, min(x + 1, width - 1))]
            before, after = 1 + p * stride, 1 + (1 - p) * stride
            left = _step(lines, before, cost, (v * width + u) * planes, ceiling, left, small, one, total, after)
            before, after = before + 2 * stride, after + 2 * stride
            right = _step(lines, before, cost, (v * width + x) * planes, ceiling, right, small, other, total, after)
            p = 1 - p
    for direction in range(2):
        lines[:] = INFINITE
        for u in range(width):
            lines[u * stride + 1 : u * stride + 1 + planes] = ceiling
        lowest[:] = 0
        p = 0
        for k in range(height):
            v = k if direction == 0 else height - 1 - k
            w = min(max(v - 1 + 2 * direction, 0), height - 1)
            for u in range(width):
                before, after = (p * width + u) * stride + 1, ((1 - p) * width + u) * stride + 1
                penalty = penalties[_difference(image, v, u, w, u)]
                lowest[u] = _step(lines, before, cost, (v * width + u) * planes, ceiling, lowest[u], small, penalty, total, after)
            p = 1 - p


@inlined
def _first_least(total, at, planes):  # type: ignore[no-untyped-def]
    """The first plane of the lowest total, and that."""
    smallest = splat_i16(INFINITE)
    for d in range(0, planes, WIDE):
        smallest = lesser(smallest, load_i16(total, at + d))
    lowest = least(smallest)
    places = splat_i16(INFINITE)
    for d in range(0, planes, WIDE):
        places = lesser(places, where_below(lowest, load_i16(total, at + d), INFINITE, counting_i16(d)))
    return least(places), lowest


@kernel
def _choose(total, cost, planes, first, step, inverse_depth, distinctness, winner_cost):  # type: ignore[no-untyped-def]
    """The winner of each pixel, between planes by a parabola; none at the first and the last of `planes` planes."""
    height, width, filled = total.shape
    for v in range(height):
        for u in range(width):
            at = (v * width + u) * filled
            k, lowest = _first_least(total, at, filled)
            others = splat_i16(INFINITE)
            for d in range(0, filled, WIDE):
                here, plane = load_i16(total, at + d), counting_i16(d)
                others = lesser(others, where_below(plane, k - 2, here, where_below(k + 2, plane, here, INFINITE)))
            distinctness[v, u] = np.float32(least(others)) / max(np.float32(lowest), np.float32(1e-3))
            winner_cost[v, u] = np.float32(0.5) * np.float32(cost[v, u, k])
            if 0 < k < planes - 1:
                left, right = np.int64(total[v, u, k - 1]), np.int64(total[v, u, k + 1])
                bend = left + right - 2 * lowest
                inverse_depth[v, u] = first + step * (k + (0.5 * (left - right) / bend if bend > 0 else 0.0))


def edge_penalties(small: float, large: float) -> Array:
    """(256,) int64 half bits: what a step to a far plane costs between pixels of such different grey levels."""
    falling = large * GRADIENT_UNIT / (GRADIENT_UNIT + np.arange(256))
    return np.asarray(np.rint(2.0 * np.clip(falling, 1.5 * small, MAX_PENALTY)), np.int64)


class PlaneSweep:
    """Sweeps pictures of one camera; keeps the memory of the cost volume between them."""

    def __init__(self, camera: Camera, config: DensificationConfig) -> None:
        self.camera, self.config = camera, config
        filled = -(-config.planes // WIDE) * WIDE
        self._ceiling = np.where(np.arange(filled) < config.planes, 0, FILLING).astype(np.int16)
        self._cost, self._total = (np.zeros((camera.height, camera.width, filled), dtype) for dtype in (np.uint8, np.int16))

    def depths(self, image: Array, sources: list[Array], motions: Array, inverse_depths: Array) -> SweptDepth:
        """The inverse depth of each pixel.

        Args:
            image: (H, W) uint8, 0 = no picture.
            sources: pictures of the neighbours, turned into the orientation of this one (`turned`).
            motions: (S, 3), X_source = X + motion in that orientation.
            inverse_depths: (D,) planes, evenly spaced, as many as the settings say.

        Raises:
            InputError: as many they are not.
        """
        if len(inverse_depths) != self.config.planes:
            raise InputError(f"{len(inverse_depths)} planes for a sweep of {self.config.planes} (densification.planes)")
        columns, rows = self._places(motions, inverse_depths)
        signatures = np.stack([np.pad(census(source), ((0, 1), (0, 1))) for source in sources])
        _sweep(census(image), signatures, columns, rows, self._cost)
        config = self.config
        penalties = edge_penalties(config.small_penalty, config.edge_penalty)
        _aggregate(self._cost, image, round(2.0 * min(config.small_penalty, MAX_PENALTY)), penalties, self._ceiling, self._total)
        found, distinctness, cost = np.zeros(image.shape), np.zeros(image.shape, np.float32), np.zeros(image.shape, np.float32)
        step = inverse_depths[1] - inverse_depths[0]
        _choose(self._total, self._cost, len(inverse_depths), inverse_depths[0], step, found, distinctness, cost)
        return SweptDepth(found, distinctness, cost)

    def _places(self, motions: Array, inverse_depths: Array) -> tuple[Array, Array]:
        """Columns (S, D, W) and rows (S, D, H) int32 in the sources where those of this picture lie at each plane; outside: W and H."""
        camera = self.camera
        with np.errstate(divide="ignore", over="ignore"):
            scale = 1.0 / np.maximum(1.0 + motions[:, 2:] * inverse_depths, 1e-6)
        ends = []
        fx, fy, cx, cy = camera.intrinsics
        for k, (focal, center, count) in enumerate(((fx, cx, camera.width), (fy, cy, camera.height))):
            moved = focal * motions[:, k : k + 1] * inverse_depths * scale + center
            at = np.floor((np.arange(count) - center) * scale[..., None] + moved[..., None] + 0.5)
            ends.append(np.where((at >= 0) & (at < count), at, count).astype(np.uint16))
        return ends[0], ends[1]


def turned(image: Array, camera: Camera, R_source_reference: Array) -> Array:
    """A picture of the source as its camera would see it in the reference's orientation; 0 outside."""
    H = camera.K @ R_source_reference @ np.linalg.inv(camera.K)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(image, H, (camera.width, camera.height), flags=flags))
