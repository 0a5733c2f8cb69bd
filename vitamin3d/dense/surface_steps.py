# SPDX-License-Identifier: Apache-2.0
"""Blocks without the voxels that are free by the whole truncation -> with those at steps of the surface, as the fused views saw them.

Where the surface has a step, a voxel behind it may be next to one far in front of it. The cube around both holds a piece of the
surface, for Open3D's own marching cubes too; but most voxels that lack were never seen, since they lie farther behind.
"""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.dense.fused_views import FusedViews
from vitamin3d.dense.marching_cubes import EMPTY, SIDE, Blocks, known_cubes, reached, signs

UNKNOWN, KNOWN, UNSEEN, ASKED = 0.0, 1.0, -1.0, -2.0
"""Weights: of a voxel that Open3D did not hand out, of one whose distance is known, of one that no view saw, of one in question."""
ROUNDS = (np.array([0b000, 0b111]), np.array([0b001, 0b110, 0b010, 0b101, 0b100, 0b011]))
"""Corners of a cube that are asked for together: those whose numbers x, y, z are odd where these bits are."""


def fill_steps(blocks: Blocks, voxel_length: float, truncation: float, views: FusedViews) -> None:
    """Sets distance and weight of the voxels that lack to a cube with a negative one, where all of these were seen.

    Two opposite corners first: a cube is lost when one was not seen, and its others need not be looked at. Cubes that reach into
    a block that is not there are left out.
    """
    cubes = np.empty((blocks.weight.size, 2), np.int32)
    cubes = cubes[: _find_incomplete(blocks.in_order(), blocks.near, blocks.distance, blocks.weight, cubes)]
    for odd in ROUNDS:
        places = np.empty((len(odd) * len(cubes), 2), np.int32)
        places = places[: _ask(cubes, blocks.near, odd, blocks.weight, places)]
        middles = np.empty((3, len(places)), np.float32)
        _place(places, blocks.keys, voxel_length, middles)
        _answer(places, views.seen(middles, truncation).distance, blocks.distance, blocks.weight)
        cubes = cubes[: _keep_seen(cubes, blocks.near, odd, blocks.weight)]


@kernel
def _find_incomplete(order, near, distance, weight, cubes):  # type: ignore[no-untyped-def]
    """Blocks and first voxels of the cubes that have a negative voxel and lack another; how many."""
    negative, known = np.empty((SIDE + 1, SIDE + 1), np.int64), np.empty((SIDE + 1, SIDE + 1), np.int64)
    count = 0
    for b in order:
        signs(near[b], distance, weight, np.float32(KNOWN), negative, known)
        for z in range(SIDE):
            for y in range(SIDE):
                some = negative[z, y] | negative[z, y + 1] | negative[z + 1, y] | negative[z + 1, y + 1]
                found = (some | some >> 1) & ~known_cubes(known, z, y) & 0xFF
                x = 0
                while found >> x:
                    if found >> x & 1 and _has_blocks(near[b], (x + 1) >> 3 | (y + 1) >> 3 << 1 | (z + 1) >> 3 << 2):
                        cubes[count, 0], cubes[count, 1] = b, x | y << 3 | z << 6
                        count += 1
                    x += 1
    return count


@inlined
def _has_blocks(near, ends):  # type: ignore[no-untyped-def]
    """Whether all blocks are there that a cube reaches into, which is at the end of its own along these axes (bits)."""
    missing = 0
    for which in range(8):
        missing += which & ends == which and near[which] == EMPTY
    return missing == 0


@inlined
def _corner(near, cube, odd):  # type: ignore[no-untyped-def]
    """Block and voxel of a cube's corner with these odd numbers."""
    i = cube[1]
    which, j = reached(i, odd ^ ((i & 1) | (i >> 3 & 1) << 1 | (i >> 6 & 1) << 2))
    return near[cube[0], which], j


@kernel
def _ask(cubes, near, odd, weight, places):  # type: ignore[no-untyped-def]
    """Blocks and voxels of the unknown ones of these corners, each once; how many."""
    count = 0
    for c in range(cubes.shape[0]):
        for k in range(odd.shape[0]):
            b, i = _corner(near, cubes[c], odd[k])
            if weight[b, i] == UNKNOWN:
                weight[b, i] = ASKED
                places[count, 0], places[count, 1] = b, i
                count += 1
    return count


@kernel
def _place(places, keys, voxel, middles):  # type: ignore[no-untyped-def]
    """Middles (3, N) of voxels in the world."""
    for n in range(places.shape[0]):
        b, i = places[n]
        middles[0, n] = (keys[b, 0] * SIDE + (i & 7) + 0.5) * voxel
        middles[1, n] = (keys[b, 1] * SIDE + (i >> 3 & 7) + 0.5) * voxel
        middles[2, n] = (keys[b, 2] * SIDE + (i >> 6) + 0.5) * voxel


@kernel
def _answer(places, seen, distance, weight):  # type: ignore[no-untyped-def]
    for n in range(places.shape[0]):
        b, i = places[n]
        if np.isnan(seen[n]):
            weight[b, i] = UNSEEN
        else:
            distance[b, i], weight[b, i] = seen[n], KNOWN


@kernel
def _keep_seen(cubes, near, odd, weight):  # type: ignore[no-untyped-def]
    """Moves the cubes of which all these corners were seen to the front, in their order; how many."""
    count = 0
    for c in range(cubes.shape[0]):
        is_seen = True
        for k in range(odd.shape[0]):
            b, i = _corner(near, cubes[c], odd[k])
            is_seen &= weight[b, i] != UNSEEN
        if is_seen:
            cubes[count, 0], cubes[count, 1] = cubes[c, 0], cubes[c, 1]
            count += 1
    return count
