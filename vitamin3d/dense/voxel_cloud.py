# SPDX-License-Identifier: Apache-2.0
"""The voxels of Open3D's ScalableTSDFVolume near the surface -> its shape, in half the time of its own marching cubes; no colours."""

from typing import Any

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.dense.block_volume import FIRST_BLOCKS, block_at, find_near, key_of
from vitamin3d.dense.marching_cubes import EMPTY, SIDE, VOXELS, Blocks, zero_level
from vitamin3d.types import Array


@kernel
def _fill(points, values, voxel, table, keys, distance, weight):  # type: ignore[no-untyped-def]
    """Sorts voxels (N, 3), given by their middles, into blocks; how many blocks, -1 where there are more than the arrays hold."""
    count = 0
    for n in range(points.shape[0]):
        x, y, z = int(np.floor(points[n, 0] / voxel)), int(np.floor(points[n, 1] / voxel)), int(np.floor(points[n, 2] / voxel))
        bx, by, bz = x // SIDE, y // SIDE, z // SIDE
        b, count = block_at(table, key_of(bx, by, bz), bx, by, bz, keys, count)
        if b == EMPTY:
            return -1
        i = x % SIDE + SIDE * (y % SIDE) + SIDE * SIDE * (z % SIDE)
        distance[b, i], weight[b, i] = 2.0 * values[n, 0] - 1.0, 1.0
    return count


def shape_of(volume: Any, voxel_length: float) -> tuple[Array, Array]:
    """Vertices (V, 3) and triangles (F, 3) of the zero level of a ScalableTSDFVolume.

    Open3D hands out the voxels whose distance is below 0.98 of the truncation; where a surface has a step larger than that, cubes
    that it would fill itself are left open.
    """
    cloud = volume.extract_voxel_point_cloud()
    blocks = _blocks(np.asarray(cloud.points), np.asarray(cloud.colors), voxel_length)
    vertices, triangles, _ = zero_level(blocks, 1.0, voxel_length)
    return vertices + 0.5 * voxel_length, triangles


def _blocks(middles: Array, values: Array, voxel_length: float) -> Blocks:
    """Blocks of voxels (N, 3), their distances as (1 + distance) / 2 in the first column of `values` (N, 3)."""
    capacity = FIRST_BLOCKS
    while True:
        table, keys = np.full((4 * capacity, 2), EMPTY, np.int64), np.empty((capacity, 3), np.int64)
        distance, weight = (np.zeros((capacity, VOXELS), np.float32) for _ in range(2))
        count = _fill(middles, values, voxel_length, table, keys, distance, weight)
        if count >= 0:
            break
        capacity *= 2
    near = find_near(table, keys[:count])
    return Blocks(keys[:count], near, distance[:count], weight[:count], np.zeros((count, VOXELS, 3), np.float32))
