# SPDX-License-Identifier: Apache-2.0
"""The voxels of Open3D's ScalableTSDFVolume -> its surface, in less time than by its own marching cubes."""

from typing import Any

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.dense.block_volume import FIRST_BLOCKS, block_at, find_near, key_of
from vitamin3d.dense.fused_views import FusedViews
from vitamin3d.dense.marching_cubes import EMPTY, SIDE, VOXELS, Blocks, zero_level
from vitamin3d.dense.surface_steps import KNOWN, fill_steps
from vitamin3d.types import Array, Surface

VIEWS_PER_CORNER = 6
"""Views that the colour of a corner of the surface is the mean of; more make it no better."""


def surface_of(volume: Any, voxel_length: float, truncation: float, views: FusedViews) -> Surface:
    """The zero level of a ScalableTSDFVolume into which all these views were integrated; normals are not filled in yet (zero).

    Open3D hands out the voxels whose distance is below 0.98 of the truncation, and no colours. Both are asked of the views: the
    voxels at steps of the surface that are larger than that (`fill_steps`), and the colours of the corners.
    """
    cloud = volume.extract_voxel_point_cloud()
    blocks = _blocks(np.asarray(cloud.points), np.asarray(cloud.colors), voxel_length)
    fill_steps(blocks, voxel_length, truncation, views)
    vertices, triangles, _ = zero_level(blocks, KNOWN, voxel_length)
    vertices += 0.5 * voxel_length
    seen = views.seen(np.ascontiguousarray(vertices.T, np.float32), truncation, VIEWS_PER_CORNER)
    return Surface(vertices, triangles, np.zeros_like(vertices), spread(seen.colors, seen.is_seen, triangles))


def spread(colors: Array, is_known: Array, triangles: Array) -> Array:
    """Colours (V, 3) uint8, those unknown set to the mean of known ones across edges, from there on; left where there is none."""
    colors, is_known = colors.copy(), is_known.copy()
    around = np.empty((len(triangles), 3), np.int32)
    around = around[: _find_around(triangles, is_known, around)]
    while True:
        pairs = np.concatenate([around[:, [a, b]] for a in range(3) for b in range(3) if a != b])
        pairs = pairs[~is_known[pairs[:, 0]] & is_known[pairs[:, 1]]]
        if not len(pairs):
            return colors
        reached, at, counts = np.unique(pairs[:, 0], return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(at, colors[pairs[:, 1], c]) for c in range(3)], axis=1)
        colors[reached], is_known[reached] = np.rint(sums / counts[:, None]), True


@kernel
def _find_around(triangles, is_known, around):  # type: ignore[no-untyped-def]
    """The triangles with an unknown corner, in their order; how many."""
    count = 0
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f]
        if not (is_known[a] and is_known[b] and is_known[c]):
            around[count, 0], around[count, 1], around[count, 2] = a, b, c
            count += 1
    return count


@kernel
def _fill(points, values, voxel, table, keys, distance, weight):  # type: ignore[no-untyped-def]
    """Sorts voxels (N, 3), given by their middles, into blocks; how many blocks, -1 where there are more than the arrays hold."""
    count, before, b = 0, EMPTY, EMPTY
    for n in range(points.shape[0]):
        x, y, z = int(np.floor(points[n, 0] / voxel)), int(np.floor(points[n, 1] / voxel)), int(np.floor(points[n, 2] / voxel))
        bx, by, bz = x // SIDE, y // SIDE, z // SIDE
        key = key_of(bx, by, bz)
        if key != before:  # mostly it is the block of the last voxel
            b, count = block_at(table, key, bx, by, bz, keys, count)
            before = key
        if b == EMPTY:
            return -1
        i = x % SIDE + SIDE * (y % SIDE) + SIDE * SIDE * (z % SIDE)
        distance[b, i], weight[b, i] = 2.0 * values[n, 0] - 1.0, KNOWN
    return count


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
    return Blocks(keys[:count], near, distance[:count], weight[:count], np.zeros((count, VOXELS, 0), np.float32))
