# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field in blocks of voxels, every pixel with its own weight (Curless and Levoy 1996)."""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.dense.marching_cubes import EMPTY, SIDE, VOXELS, Blocks, zero_level
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView

KEY_BITS, KEY_OFFSET = 21, 1 << 20
FIRST_BLOCKS = 1 << 13
"""Capacity at the start; doubles when it is used up."""
ROUNDING = 1e-4
"""Of a view's weight; what remains below it after the view was taken out is not left of others."""
RAY_STRIDE = 3
"""Pixels between the rays along which blocks are allocated."""


@inlined
def _key(x, y, z):  # type: ignore[no-untyped-def]
    return ((x + KEY_OFFSET) << (2 * KEY_BITS)) | ((y + KEY_OFFSET) << KEY_BITS) | (z + KEY_OFFSET)


@inlined
def _slot(table, key):  # type: ignore[no-untyped-def]
    """Row of `table` (C, 2), C a power of two, that holds the key, or the empty one where it belongs (linear probing)."""
    mask = table.shape[0] - 1
    at = ((key * 0x9E3779B97F4A7C1) >> 20) & mask
    while table[at, 0] != EMPTY and table[at, 0] != key:
        at = (at + 1) & mask
    return at


@kernel
def _rehash(old, new):  # type: ignore[no-untyped-def]
    for i in range(old.shape[0]):
        if old[i, 0] != EMPTY:
            at = _slot(new, old[i, 0])
            new[at, 0], new[at, 1] = old[i, 0], old[i, 1]


@kernel
def _find_near(table, keys, near):  # type: ignore[no-untyped-def]
    """Rows (N, 8) of the blocks at a block's key and one further along x, y, z (bits of the column), -1 where there is none."""
    for b in range(keys.shape[0]):
        for k in range(8):
            at = _slot(table, _key(keys[b, 0] + (k & 1), keys[b, 1] + (k >> 1 & 1), keys[b, 2] + (k >> 2)))
            near[b, k] = table[at, 1]


@kernel
def _touch(depth, intrinsics, T_world_cam, block, reach, max_depth, stride, table, keys, count, stamps, stamp, touched):  # type: ignore[no-untyped-def]
    """Allocates the blocks within `reach` of the surface along the rays; (blocks now, blocks of this view), or -1: table full."""
    fx, fy, cx, cy = intrinsics
    found = 0
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if not 0.0 < z < max_depth:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            length = np.sqrt(x * x + y * y + 1.0)
            steps = int(np.ceil(2.0 * reach / (0.5 * block)))
            for k in range(steps + 1):
                d = z + (2.0 * k / steps - 1.0) * reach / length
                if d <= 0.0:
                    continue
                bx = int(
                    np.floor((T_world_cam[0, 0] * x * d + T_world_cam[0, 1] * y * d + T_world_cam[0, 2] * d + T_world_cam[0, 3]) / block)
                )
                by = int(
                    np.floor((T_world_cam[1, 0] * x * d + T_world_cam[1, 1] * y * d + T_world_cam[1, 2] * d + T_world_cam[1, 3]) / block)
                )
                bz = int(
                    np.floor((T_world_cam[2, 0] * x * d + T_world_cam[2, 1] * y * d + T_world_cam[2, 2] * d + T_world_cam[2, 3]) / block)
                )
                key = _key(bx, by, bz)
                at = _slot(table, key)
                if table[at, 0] == EMPTY:
                    if count >= keys.shape[0]:
                        return -1, found
                    table[at, 0], table[at, 1] = key, count
                    keys[count, 0], keys[count, 1], keys[count, 2] = bx, by, bz
                    count += 1
                b = table[at, 1]
                if stamps[b] != stamp:
                    stamps[b] = stamp
                    touched[found] = b
                    found += 1
    return count, found


@kernel
def _integrate(depth, pixel_weights, color, intrinsics, R, t, voxel, truncation, max_depth, touched, keys, distance, weight, shade, sign):  # type: ignore[no-untyped-def]
    """Averages the signed distance along the ray, in truncations, and the colour into the voxels of the blocks `touched`.

    With `sign` -1 the view is taken out again; a voxel of which nothing is left but rounding becomes empty.
    """
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for n in range(touched.shape[0]):
        b = touched[n]
        for i in range(VOXELS):
            wx = (keys[b, 0] * SIDE + i % SIDE) * voxel
            wy = (keys[b, 1] * SIDE + (i // SIDE) % SIDE) * voxel
            wz = (keys[b, 2] * SIDE + i // (SIDE * SIDE)) * voxel
            z = R[2, 0] * wx + R[2, 1] * wy + R[2, 2] * wz + t[2]
            if z <= 0.0:
                continue
            x = (R[0, 0] * wx + R[0, 1] * wy + R[0, 2] * wz + t[0]) / z
            y = (R[1, 0] * wx + R[1, 1] * wy + R[1, 2] * wz + t[1]) / z
            u, v = int(np.floor(fx * x + cx + 0.5)), int(np.floor(fy * y + cy + 0.5))
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            d = depth[v, u]
            if not 0.0 < d < max_depth:
                continue
            signed = (d - z) * np.sqrt(x * x + y * y + 1.0) / truncation
            if signed < -1.0:
                continue
            w = pixel_weights[v, u]
            if signed < 0.0:
                w *= 1.0 + signed  # what is behind the surface was not seen
            if not w > 0.0:
                continue
            before = weight[b, i]
            after = before + sign * w
            if after < ROUNDING * w:
                distance[b, i], weight[b, i] = 0.0, 0.0
                shade[b, i, 0], shade[b, i, 1], shade[b, i, 2] = 0.0, 0.0, 0.0
                continue
            share = sign * w / after
            distance[b, i] += share * (min(signed, 1.0) - distance[b, i])
            weight[b, i] = after
            for c in range(3):
                shade[b, i, c] += share * (color[v, u, c] - shade[b, i, c])


class BlockVolume:
    """Blocks of 8³ voxels near the surface, found through a hash table; memory grows with the area of the surface.

    Args:
        voxel_length: map units.
        truncation: map units.
        max_deviation: map units; the surface is extracted where the views together know it better than this.
    """

    def __init__(self, voxel_length: float, truncation: float, max_deviation: float) -> None:
        self.voxel_length, self.truncation, self.min_weight = voxel_length, truncation, max_deviation**-2
        self.num_blocks, self._num_views = 0, 0
        self._table = np.full((4 * FIRST_BLOCKS, 2), EMPTY, np.int64)
        self._keys, self._stamps = np.zeros((FIRST_BLOCKS, 3), np.int64), np.zeros(FIRST_BLOCKS, np.int64)
        self._distance, self._weight = (np.zeros((FIRST_BLOCKS, VOXELS), np.float32) for _ in range(2))
        self._shade = np.zeros((FIRST_BLOCKS, VOXELS, 3), np.float32)

    @property
    def num_bytes(self) -> int:
        """Memory of the voxels."""
        return sum(array.nbytes for array in (self._table, self._keys, self._stamps, self._distance, self._weight, self._shade))

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Averages a view, drawn on `canvas`, into the volume; each pixel by its weight."""
        self._add(view, canvas, max_depth, 1.0)

    def remove(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Takes a view out that was integrated just so; what remains is the average of the others but for rounding."""
        self._add(view, canvas, max_depth, -1.0)

    def _add(self, view: DepthView, canvas: Camera, max_depth: float, sign: float) -> None:
        touched = self._touched(view, canvas, max_depth)
        R, t = np.ascontiguousarray(view.T_cam_world[:3, :3]), np.ascontiguousarray(view.T_cam_world[:3, 3])
        _integrate(
            view.depth, view.weights, view.color, canvas.intrinsics, R, t, self.voxel_length, self.truncation, max_depth,
            touched, self._keys, self._distance, self._weight, self._shade, sign,
        )  # fmt: skip

    def _touched(self, view: DepthView, canvas: Camera, max_depth: float) -> Array:
        """Blocks (N,) near the surface of a view; new ones are allocated."""
        T_world_cam, block = np.ascontiguousarray(inverse(view.T_cam_world)), SIDE * self.voxel_length
        while True:
            self._num_views += 1
            touched = np.empty(len(self._keys), np.int64)
            count, found = _touch(
                view.depth, canvas.intrinsics, T_world_cam, block, self.truncation, max_depth, RAY_STRIDE,
                self._table, self._keys, self.num_blocks, self._stamps, self._num_views, touched,
            )  # fmt: skip
            if count >= 0:
                self.num_blocks = count
                return touched[:found]
            self.num_blocks = len(self._keys)
            self._double()

    def _double(self) -> None:
        table = np.full((2 * len(self._table), 2), EMPTY, np.int64)
        _rehash(self._table, table)
        self._table = table
        self._keys, self._stamps, self._distance, self._weight, self._shade = (
            np.concatenate([array, np.zeros_like(array)]) for array in (self._keys, self._stamps, self._distance, self._weight, self._shade)
        )

    def extract(self) -> tuple[Array, Array, Array]:
        """Vertices (V, 3), triangles (F, 3) and colours (V, 3) in 0–1 of the zero level, in an order that depends on the values alone."""
        n = self.num_blocks
        near = np.empty((n, 8), np.int64)
        _find_near(self._table, self._keys[:n], near)
        blocks = Blocks(self._keys[:n], near, self._distance[:n], self._weight[:n], self._shade[:n])
        vertices, triangles, colors = zero_level(blocks, self.min_weight, self.voxel_length)
        return vertices, triangles, colors / np.float32(255.0)
