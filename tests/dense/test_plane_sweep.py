# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import DensificationConfig
from vitamin3d.dense import plane_sweep
from vitamin3d.dense.plane_sweep import PlaneSweep, census, turned
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.se3 import exp_se3

TINY = PinholeCamera(20.0, 21.0, 10.3, 7.6, 22, 16)
CAMERA = reference.SMALL


def noise(shape, seed=0, low=0):
    return np.random.default_rng(seed).integers(low, 255, shape).astype(np.uint8)


def test_signatures_are_those_of_the_definition():
    image = noise((TINY.height, TINY.width))
    ours, theirs = census(image), reference.census(image)
    assert 0 < sum(s is not None for s in theirs.ravel()) < image.size
    for signature, text in zip(ours.ravel(), theirs.ravel(), strict=True):
        assert bin(int(signature))[2:] == ("0" if text is None else "1" + text[:31] + "0" + text[31:])  # the centre itself


def test_costs_are_those_of_the_definition():
    image, sources = noise((TINY.height, TINY.width), 1, 1), [noise((TINY.height, TINY.width), seed, 1) for seed in (2, 3, 4)]
    motions = np.array([[0.31, 0.02, 0.1], [-0.27, 0.1, -0.13], [0.05, -0.4, 0.02]])
    planes = np.linspace(0.2, 1.4, 6)
    sweep = PlaneSweep(TINY, DensificationConfig(planes=6))
    sweep.depths(image, sources, motions, planes)
    expected = reference.sweep_cost(image, sources, motions, TINY, planes)
    assert len(np.unique(expected)) > 10
    np.testing.assert_array_equal(0.5 * sweep._cost[..., :6], expected)


def test_paths_are_those_of_the_definition():
    rng, planes = np.random.default_rng(5), 19
    cost, image = rng.integers(0, 125, (7, 9, planes)).astype(np.uint8), noise((7, 9))
    filled, total, ceiling = np.zeros((7, 9, 32), np.uint8), np.empty((7, 9, 32), np.int16), np.full(32, plane_sweep.FILLING, np.int16)
    filled[..., :planes], ceiling[:planes] = cost, 0
    plane_sweep._aggregate(filled, image, 6, plane_sweep.edge_penalties(3.0, 20.0), ceiling, total)
    expected = sum(reference.path_cost(cost, image, 6.0, 40.0, step) for step in ((0, 1), (0, -1), (1, 0), (-1, 0)))
    np.testing.assert_array_equal(total[..., :planes], expected)
    assert total[..., planes:].min() > total[..., :planes].max()


def test_the_winner_is_that_of_the_definition():
    rng, planes = np.random.default_rng(6), 21
    cost, total = rng.integers(0, 125, (8, 9, 32)).astype(np.uint8), rng.integers(50, 400, (8, 9, 32)).astype(np.int16)
    total[..., planes:] = 4 * plane_sweep.FILLING
    found, distinctness, winner_cost = np.zeros((8, 9)), np.zeros((8, 9), np.float32), np.zeros((8, 9), np.float32)
    plane_sweep._choose(total, cost, planes, 0.2, 0.1, found, distinctness, winner_cost)
    for v, u in np.ndindex(8, 9):
        t = total[v, u, :planes].astype(float)
        k = int(t.argmin())
        assert winner_cost[v, u] == 0.5 * cost[v, u, k]
        assert distinctness[v, u] == pytest.approx(t[np.abs(np.arange(planes) - k) > 2].min() / t[k])
        between = (t[k - 1] - t[k + 1]) / (t[k - 1] + t[k + 1] - 2 * t[k]) / 2 if 0 < k < planes - 1 else 0.0
        assert found[v, u] == pytest.approx(0.2 + 0.1 * (k + between) if 0 < k < planes - 1 else 0.0)


def shifted_scene(disparity_per_depth, inverse_depth):
    """A random texture at one depth and the same seen from a camera moved along x, in both directions."""
    texture = noise((CAMERA.height, 3 * CAMERA.width), 7, 1)
    shift = round(disparity_per_depth * inverse_depth)
    return [texture[:, CAMERA.width + s : 2 * CAMERA.width + s] for s in (0, shift, -shift)]


@pytest.mark.parametrize("inverse_depth", [0.3, 0.62])
def test_a_wall_is_found_and_is_distinct(inverse_depth):
    baseline = 0.2
    image, right, left = shifted_scene(CAMERA.fx * baseline, inverse_depth)
    motions = np.array([[-baseline, 0, 0], [baseline, 0, 0]])
    exact = round(CAMERA.fx * baseline * inverse_depth) / (CAMERA.fx * baseline)
    swept = PlaneSweep(CAMERA, DensificationConfig(planes=64)).depths(image, [right, left], motions, np.linspace(0.1, 1.0, 64))
    inside = np.s_[10:-10, 30:-30]
    assert np.median(np.abs(swept.inverse_depth[inside] - exact)) < 0.05
    assert np.median(swept.distinctness[inside]) > 1.5 and np.median(swept.cost[inside]) < 1.0


def test_a_sweep_takes_as_many_planes_as_it_has_memory_for():
    flat = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    with pytest.raises(InputError, match="64 planes for a sweep of 48"):
        PlaneSweep(CAMERA, DensificationConfig(planes=48)).depths(flat, [flat], 0.1 * np.eye(3)[:1], np.linspace(0.1, 1.0, 64))


def test_without_texture_nothing_is_distinct():
    flat = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    swept = PlaneSweep(CAMERA, DensificationConfig(planes=64)).depths(flat, [flat, flat], 0.1 * np.eye(3)[:2], np.linspace(0.1, 1.0, 64))
    assert swept.distinctness[20:-20, 20:-20].max() < 1.01


def test_a_turned_picture_shows_what_the_turned_camera_sees():
    R = exp_se3(np.array([0, 0, 0, 0.05, -0.08, 0.1]))[:3, :3]
    grid = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1).reshape(-1, 2).astype(float)

    def seen(rays):  # a smooth picture of directions
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return (128 + 60 * np.sin(7 * directions[:, 0]) + 50 * np.cos(9 * directions[:, 1])).reshape(CAMERA.height, CAMERA.width)

    rays = CAMERA.rays_from_ideal(grid)
    picture = turned(np.rint(seen(rays @ R)).astype(np.uint8), CAMERA, R)
    known = picture > 0
    assert 0.6 < known.mean() < 1.0
    core = np.s_[20:-20, 25:-25]
    assert np.abs(picture.astype(float) - seen(rays))[core][known[core]].max() < 2.0
