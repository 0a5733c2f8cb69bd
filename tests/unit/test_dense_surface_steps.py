# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from vitamin3d.dense.fused_views import Seen
from vitamin3d.dense.marching_cubes import SIDE
from vitamin3d.dense.surface_steps import KNOWN, fill_steps
from vitamin3d.dense.voxel_cloud import _blocks

VOXEL = 0.05
CUBE = list(itertools.product(range(2), repeat=3))


class Oracle:
    """Stands for the views: sees a voxel by its numbers."""

    def __init__(self, distances):
        self.distances, self.asked = distances, []

    def seen(self, points, truncation):
        voxels = np.rint(points.T / VOXEL - 0.5).astype(int)
        np.testing.assert_allclose(points.T, (voxels + 0.5) * VOXEL, atol=1e-5)
        self.asked += [tuple(voxel) for voxel in voxels.tolist()]
        found = np.array([self.distances.get(tuple(voxel), np.nan) for voxel in voxels], np.float32)
        return Seen(found, np.zeros((len(found), 3), np.uint8))


def scene(seed, share_known):
    """Voxels that were handed out, and what the views saw of the others."""
    rng = np.random.default_rng(seed)
    low, high = (-12, -3, 0), (9, 13, 16)
    voxels = list(itertools.product(*map(range, low, high)))
    known = {v: float(rng.uniform(-0.97, 0.97)) for v in voxels if rng.random() < share_known}
    others = {v: float(rng.choice([1.0, -0.99])) for v in voxels if v not in known and rng.random() < 0.6}
    return known, others


def blocks_of(distances):
    """As Open3D hands them out."""
    middles = (np.array(list(distances)) + 0.5) * VOXEL
    return _blocks(middles, np.repeat(0.5 * (np.array(list(distances.values()))[:, None] + 1), 3, axis=1), VOXEL)


def state(blocks):
    """Distances of the voxels that are known."""
    found = {}
    for key, distance, weight in zip(blocks.keys, blocks.distance, blocks.weight, strict=True):
        for i in np.flatnonzero(weight == KNOWN):
            found[tuple(int(n) for n in SIDE * key + [i % SIDE, i // SIDE % SIDE, i // SIDE**2])] = float(distance[i])
    return found


def corners(cube):
    return [tuple(n + d for n, d in zip(cube, step, strict=True)) for step in CUBE]


@pytest.mark.parametrize(("seed", "share_known"), [(0, 0.3), (1, 0.6), (2, 0.9)])
def test_cubes_are_completed_where_all_that_they_lack_was_seen(seed, share_known):
    known, others = scene(seed, share_known)
    blocks = blocks_of(known)
    there, before, oracle = {tuple(int(n) for n in key) for key in blocks.keys}, state(blocks), Oracle(others)
    fill_steps(blocks, VOXEL, 3 * VOXEL, oracle)
    after = state(blocks)
    completed = 0
    for cube in {tuple(n - d for n, d in zip(v, step, strict=True)) for v in known for step in CUBE}:
        voxels = corners(cube)
        lacking = [v for v in voxels if v not in known]
        is_there = all(tuple(n // SIDE for n in v) in there for v in voxels)
        if lacking and is_there and any(known.get(v, 0.0) < 0 for v in voxels):
            assert all(v in after for v in voxels) == all(v in others for v in lacking)
            completed += all(v in after for v in voxels)
    assert completed > 50
    assert all(after[v] == before[v] for v in before)
    assert all(after[v] == pytest.approx(others[v]) for v in after.keys() - before.keys())


def test_each_voxel_is_asked_for_once_and_none_without_need():
    known, others = scene(3, 0.5)
    oracle = Oracle(others)
    fill_steps(blocks_of(known), VOXEL, 3 * VOXEL, oracle)
    assert len(oracle.asked) == len(set(oracle.asked)) > 0 and not set(oracle.asked) & known.keys()
    oracle = Oracle(others)
    fill_steps(blocks_of({v: abs(d) for v, d in known.items()}), VOXEL, 3 * VOXEL, oracle)  # nothing is behind a surface
    assert not oracle.asked
