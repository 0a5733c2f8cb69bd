# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.dense import voxel_cloud
from vitamin3d.dense.marching_cubes import EMPTY, SIDE

VOXEL = 0.07


@pytest.mark.parametrize("first_blocks", [2, 1 << 13])
def test_each_voxel_is_where_it_was_and_blocks_know_their_neighbours(rng, monkeypatch, first_blocks):
    monkeypatch.setattr(voxel_cloud, "FIRST_BLOCKS", first_blocks)
    places = np.unique(rng.integers(-20, 20, (3000, 3)), axis=0)
    distances = rng.uniform(-0.98, 0.98, len(places))
    values = np.repeat(0.5 * (distances[:, None] + 1.0), 3, axis=1)
    blocks = voxel_cloud._blocks((places + 0.5) * VOXEL, values, VOXEL)
    expected = {tuple(place): distance for place, distance in zip(places, distances, strict=True)}
    found = {}
    for key, distance, weight in zip(blocks.keys, blocks.distance, blocks.weight, strict=True):
        for i in np.flatnonzero(weight):
            found[tuple(SIDE * key + [i % SIDE, i // SIDE % SIDE, i // SIDE**2])] = distance[i]
    assert found.keys() == expected.keys()
    assert all(found[place] == pytest.approx(expected[place], abs=1e-6) for place in expected)
    rows = {tuple(key): row for row, key in enumerate(blocks.keys)}
    for key, near in zip(blocks.keys, blocks.near, strict=True):
        for k in range(8):
            assert near[k] == rows.get((key[0] + (k & 1), key[1] + (k >> 1 & 1), key[2] + (k >> 2)), EMPTY)


def test_unknown_colours_come_from_the_known_ones_around():
    triangles = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7]], np.int32)
    colors = np.array([[10] * 3, [20] * 3, [0] * 3, [0] * 3, [0] * 3, [0] * 3, [0] * 3, [0] * 3], np.uint8)
    is_known = np.array([True, True, False, False, False, False, False, False])
    spread = voxel_cloud.spread(colors, is_known, triangles)
    # 2 is beside 0 and, in two triangles, 1; 3 beside 1; 4 beside 2 and 3 in the next round; 5 to 7 hang on nothing
    np.testing.assert_array_equal(spread[:, 0], [10, 20, 17, 20, 18, 0, 0, 0])
    np.testing.assert_array_equal(colors[2:], 0)
    np.testing.assert_array_equal(voxel_cloud.spread(colors, np.ones(8, bool), triangles), colors)
    np.testing.assert_array_equal(voxel_cloud.spread(colors, np.zeros(8, bool), triangles), colors)
