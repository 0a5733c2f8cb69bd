# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field in blocks of voxels, every pixel with its own weight (Curless and Levoy 1996)."""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.dense.marching_cubes import EMPTY, SIDE, VOXELS, Blocks, zero_level
from vitamin3d.geometry.cameras import Camera
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
def key_of(x, y, z):  # type: ignore[no-untyped-def]
    """One number for the block (x, y, z)."""
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


@inlined
def block_at(table, key, x, y, z, keys, count):  # type: ignore[no-untyped-def]
    """The number of the block (x, y, z) with this key, a new one if there is none yet, and how many there are; `EMPTY`: full."""
    at = _slot(table, key)
    if table[at, 0] == EMPTY:
        if count >= keys.shape[0]:
            return EMPTY, count
        table[at, 0], table[at, 1] = key, count
        keys[count, 0], keys[count, 1], keys[count, 2] = x, y, z
        count += 1
    return table[at, 1], count


@kernel
def _fill_near(table, keys, near):  # type: ignore[no-untyped-def]
    """Rows (N, 8) of the blocks at a block's key and one further along x, y, z (bits of the column), -1 where there is none."""
    for b in range(keys.shape[0]):
        for k in range(8):
            at = _slot(table, key_of(keys[b, 0] + (k & 1), keys[b, 1] + (k >> 1 & 1), keys[b, 2] + (k >> 2)))
            near[b, k] = table[at, 1]


def find_near(table: Array, keys: Array) -> Array:
    """`Blocks.near` (N, 8) of blocks with keys (N, 3) in the hash table."""
    near = np.empty((len(keys), 8), np.int64)
    _fill_near(table, keys, near)
    return near


@inlined
def _place(T, k, x, y, d, block):  # type: ignore[no-untyped-def]
    """Block along one axis of the world in which the point at depth d of the ray (x, y, 1) lies."""
    return int(np.floor(((T[k, 0] * x + T[k, 1] * y + T[k, 2]) * d + T[k, 3]) / block))


@kernel
def _touch(depth, intrinsics, T_world_cam, block, reach, max_depth, stride, table, keys, count, stamps, stamp, touched):  # type: ignore[no-untyped-def]
    """Allocates the blocks within `reach` of the surface along the rays; (blocks now, blocks of this view), or -1: table full."""
    fx, fy, cx, cy = intrinsics
    found, steps = 0, int(np.ceil(2.0 * reach / (0.5 * block)))
    before = np.full(steps + 1, EMPTY, np.int64)  # of the last ray: mostly the same blocks
    for v in range(0, depth.shape[0], stride):
        y = (v - cy) / fy
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if not 0.0 < z < max_depth:
                continue
            x = (u - cx) / fx
            length = np.sqrt(x * x + y * y + 1.0)
            for k in range(steps + 1):
                d = z + (2.0 * k / steps - 1.0) * reach / length
                if d <= 0.0:
                    continue
                bx, by, bz = (
                    _place(T_world_cam, 0, x, y, d, block),
                    _place(T_world_cam, 1, x, y, d, block),
                    _place(T_world_cam, 2, x, y, d, block),
                )
                key = key_of(bx, by, bz)
                if key == before[k]:
                    continue
                before[k] = key
                b, count = block_at(table, key, bx, by, bz, keys, count)
                if b == EMPTY:
                    return -1, found
                if stamps[b] != stamp:
                    stamps[b] = stamp
                    touched[found] = b
                    found += 1
    return count, found


@inlined
def _project(key, camera, R, t, voxel, truncation, width, height, pixel, far, scale):  # type: ignore[no-untyped-def]
    """Of each voxel of a block the pixel that it falls on (-1: none), its depth, and truncations per depth along the ray.

    Without a branch, so that LLVM does several voxels at a time.
    """
    fx, fy, cx, cy = camera
    x_0, y_0, z_0 = key[0] * SIDE * voxel, key[1] * SIDE * voxel, key[2] * SIDE * voxel
    for row in range(SIDE * SIDE):
        wy, wz = y_0 + (row % SIDE) * voxel, z_0 + (row // SIDE) * voxel
        a = np.float32(R[0, 0] * x_0 + R[0, 1] * wy + R[0, 2] * wz + t[0])
        b = np.float32(R[1, 0] * x_0 + R[1, 1] * wy + R[1, 2] * wz + t[1])
        c = np.float32(R[2, 0] * x_0 + R[2, 1] * wy + R[2, 2] * wz + t[2])
        da, db, dc = np.float32(R[0, 0] * voxel), np.float32(R[1, 0] * voxel), np.float32(R[2, 0] * voxel)
        for k in range(SIDE):
            z = c + np.float32(k) * dc
            x, y = (a + np.float32(k) * da) / z, (b + np.float32(k) * db) / z
            u, v = np.floor(fx * x + cx), np.floor(fy * y + cy)
            is_seen = (z > np.float32(0.0)) & (u >= np.float32(0.0)) & (v >= np.float32(0.0)) & (u < width) & (v < height)
            i = row * SIDE + k
            pixel[i] = np.int32(v) * np.int32(width) + np.int32(u) if is_seen else np.int32(-1)
            far[i] = z
            scale[i] = np.sqrt(x * x + y * y + np.float32(1.0)) / truncation


@kernel
def _integrate(depth, pixel_weights, color, camera, R, t, voxel, truncation, max_depth, touched, keys, distance, weight, shade, sign):  # type: ignore[no-untyped-def]
    """Averages the signed distance along the ray, in truncations, and the colour into the voxels of the blocks `touched`.

    With `sign` -1 the view is taken out again; a voxel of which nothing is left but rounding becomes empty. `camera` float32:
    focal lengths, and the centre moved by half a pixel.
    """
    width, height = np.float32(depth.shape[1]), np.float32(depth.shape[0])
    pixel, far, scale = np.empty(VOXELS, np.int32), np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32)
    depths, weights, colors = depth.reshape(-1), pixel_weights.reshape(-1), color.reshape(-1, 3)
    for b in touched:
        _project(keys[b], camera, R, t, voxel, np.float32(truncation), width, height, pixel, far, scale)
        for i in range(VOXELS):
            p = pixel[i]
            if p < 0:
                continue
            d = depths[p]
            if not 0.0 < d < max_depth:
                continue
            signed = (d - far[i]) * scale[i]
            if signed < np.float32(-1.0):
                continue
            w = weights[p]
            if signed < np.float32(0.0):
                w *= np.float32(1.0) + signed  # what is behind the surface was not seen
            if not w > 0.0:
                continue
            after = weight[b, i] + sign * w
            if after < ROUNDING * w:
                distance[b, i], weight[b, i] = 0.0, 0.0
                shade[b, i, 0], shade[b, i, 1], shade[b, i, 2] = 0.0, 0.0, 0.0
                continue
            share = sign * w / after
            distance[b, i] += share * (min(signed, np.float32(1.0)) - distance[b, i])
            weight[b, i] = after
            for c in range(3):
                shade[b, i, c] += share * (np.float32(colors[p, c]) - shade[b, i, c])


def pixel_camera(canvas: Camera) -> Array:
    """(4,) float32: focal lengths, and the centre moved by half a pixel, so that rounding down gives the pixel of a projection."""
    return np.asarray(canvas.intrinsics + np.array([0.0, 0.0, 0.5, 0.5]), np.float32)


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
        camera = pixel_camera(canvas)
        R, t = np.ascontiguousarray(view.T_cam_world[:3, :3]), np.ascontiguousarray(view.T_cam_world[:3, 3])
        _integrate(
            view.depth, view.weights, view.color, camera, R, t, self.voxel_length, self.truncation, np.float32(max_depth),
            touched, self._keys, self._distance, self._weight, self._shade, np.float32(sign),
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
            _doubled(array) for array in (self._keys, self._stamps, self._distance, self._weight, self._shade)
        )

    def extract(self) -> tuple[Array, Array, Array]:
        """Vertices (V, 3), triangles (F, 3) and colours (V, 3) in 0–1 of the zero level, in an order that depends on the values alone."""
        n = self.num_blocks
        near = find_near(self._table, self._keys[:n])
        blocks = Blocks(self._keys[:n], near, self._distance[:n], self._weight[:n], self._shade[:n])
        vertices, triangles, colors = zero_level(blocks, self.min_weight, self.voxel_length)
        return vertices, triangles, colors / np.float32(255.0)


def _doubled(array: Array) -> Array:
    """Twice as long, zeros behind; these take memory only when they are written."""
    longer = np.zeros((2 * len(array), *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer
