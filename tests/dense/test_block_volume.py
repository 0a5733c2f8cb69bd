# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference
from scipy.spatial import cKDTree

from vitamin3d.dense import block_volume
from vitamin3d.dense.block_volume import SIDE, BlockVolume
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.types import DepthView

CAMERA = reference.SMALL
VOXEL = 0.05


def wall(depth, weight=1.0, shift=0.0):
    """A wall across the view of a camera that moved by `shift` along x."""
    shape = (CAMERA.height, CAMERA.width)
    color = np.full((*shape, 3), [10, 200, 90], np.uint8)
    T = inverse(exp_se3(np.array([shift, 0, 0, 0, 0.1 * shift, 0])))
    return DepthView(0, T, np.full(shape, depth, np.float32), np.zeros((*shape, 3), np.float32), color, np.full(shape, weight, np.float32))


def fused(*views, max_deviation=1e3, max_depth=5.0):
    volume = BlockVolume(VOXEL, 4 * VOXEL, max_deviation)
    for view in views:
        volume.integrate(view, CAMERA, max_depth)
    return volume


def test_voxels_are_those_of_the_definition():
    views = [wall(1.5, 2.0), wall(1.6, 0.5, 0.3)]
    volume = fused(*views)
    rng = np.random.default_rng(0)
    blocks, voxels = rng.integers(0, volume.num_blocks, 400), rng.integers(0, SIDE**3, 400)
    offsets = np.stack([voxels % SIDE, voxels // SIDE % SIDE, voxels // SIDE**2], axis=1)
    points = (volume._keys[blocks] * SIDE + offsets) * VOXEL
    distances, weights = reference.signed_distances(views, CAMERA, points, 4 * VOXEL, 5.0)
    touched = volume._weight[blocks, voxels] > 0
    assert 50 < touched.sum() < 400
    np.testing.assert_allclose(volume._distance[blocks, voxels][touched], distances[touched], atol=2e-4)
    np.testing.assert_allclose(volume._weight[blocks, voxels], weights, atol=2e-4)


def test_a_view_taken_out_leaves_what_the_others_say():
    others, moved = [wall(1.523, 2.0), wall(1.6, 0.5, 0.3)], wall(1.7, 3.0, -0.4)
    volume, expected = fused(others[0], moved, others[1]), fused(*others)
    volume.remove(moved, CAMERA, 5.0)
    place = {tuple(key): k for k, key in enumerate(expected._keys[: expected.num_blocks])}
    assert volume.num_blocks > expected.num_blocks  # those of the view alone stay, empty
    for k, key in enumerate(map(tuple, volume._keys[: volume.num_blocks])):
        twin = place.get(key)
        weight, distance = (0.0, 0.0) if twin is None else (expected._weight[twin], expected._distance[twin])
        np.testing.assert_allclose(volume._weight[k], weight, atol=1e-3)
        firm = volume._weight[k] > 0.01
        np.testing.assert_allclose(volume._distance[k][firm], np.broadcast_to(distance, firm.shape)[firm], atol=1e-3)
    one, other = volume.extract(), expected.extract()
    assert [len(values) for values in one] == [len(values) for values in other]
    assert cKDTree(one[0]).query(other[0])[0].max() < 1e-4


def test_the_certain_view_leads():
    vertices, _, colors = fused(wall(1.5, 9.0), wall(1.6, 1.0)).extract()
    middle = np.abs(vertices[:, :2]).max(axis=1) < 0.4
    assert np.median(vertices[middle, 2]) == pytest.approx(1.51, abs=0.01)
    np.testing.assert_allclose(np.median(colors, axis=0), np.array([10, 200, 90]) / 255.0, atol=0.01)


def test_what_is_known_too_badly_is_no_surface():
    views = [wall(1.5, 4.0), wall(1.5, 4.0)]
    assert len(fused(*views, max_deviation=0.5).extract()[0]) > 100
    assert len(fused(*views, max_deviation=0.3).extract()[0]) == 0


def test_more_blocks_than_at_the_start(monkeypatch):
    plain = fused(wall(1.5), wall(1.5, 1.0, 1.0)).extract()
    monkeypatch.setattr(block_volume, "FIRST_BLOCKS", 16)
    volume = fused(wall(1.5), wall(1.5, 1.0, 1.0))
    assert volume.num_blocks > 64 and volume.num_bytes > volume.num_blocks * SIDE**3 * 20
    for one, other in zip(plain, volume.extract(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_pixels_without_weight_or_depth_leave_no_trace():
    view = wall(1.5)
    none = dataclasses.replace(view, weights=np.zeros_like(view.weights))
    assert len(fused(none).extract()[0]) == 0
    assert fused(dataclasses.replace(view, depth=np.zeros_like(view.depth))).num_blocks == 0
    assert fused(view, max_depth=1.0).num_blocks == 0


def test_keys_far_from_the_origin_stay_apart():
    far = dataclasses.replace(wall(1.5), T_cam_world=inverse(exp_se3(np.array([-700.0, 300.0, 900.0, 0, 0, 0]))))
    vertices = fused(wall(1.5), far).extract()[0]
    assert (np.abs(vertices[:, 2] - 1.5) < 0.1).sum() == pytest.approx((np.abs(vertices[:, 2] - 901.5) < 0.1).sum(), rel=0.2)
