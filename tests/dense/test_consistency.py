# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference_dense as reference

from vitamin3d.dense.consistency import compared, voted
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.types import DepthView

CAMERA = reference.SMALL


def wall(depth, x=0.0):
    """A wall at z = `depth` of the world, seen from (x, 0, 0)."""
    shape = (CAMERA.height, CAMERA.width)
    T = inverse(exp_se3(np.array([x, 0, 0, 0, 0, 0])))
    blank = np.zeros((*shape, 3), np.uint8)
    return DepthView(0, T, np.full(shape, depth, np.float32), blank.astype(np.float32), blank, np.full(shape, 4.0, np.float32))


def by_definition(view, others, tolerance):
    same, different = np.zeros(view.depth.shape, int), np.zeros(view.depth.shape, int)
    for v, u in np.ndindex(same.shape):
        X = view.depth[v, u] * np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        for other in others:
            if view.depth[v, u] == 0:
                continue
            x, y, z, _ = other.T_cam_world @ inverse(view.T_cam_world) @ [*X, 1.0]
            m, n = (int(np.floor(value + 0.5)) for value in (CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy))
            if 0 <= m < CAMERA.width and 0 <= n < CAMERA.height:
                agrees = abs(other.depth[n, m] - z) < tolerance * z
                same[v, u] += agrees
                different[v, u] += not agrees and other.depth[n, m] > 0
    return same, different


def test_comparison_is_that_of_the_definition():
    rng = np.random.default_rng(0)
    views = [wall(2.0, x) for x in (0.0, 0.21, -0.17)]
    for view in views:
        view.depth[:] *= rng.uniform(0.93, 1.07, view.depth.shape).astype(np.float32)
        view.depth[rng.uniform(size=view.depth.shape) < 0.1] = 0.0
    same, different = compared(views[0], views[1:], CAMERA, 0.03)
    true_same, true_different = by_definition(views[0], views[1:], 0.03)
    assert set(np.unique(true_same)) == {0, 1, 2} == set(np.unique(true_different))
    assert (same != true_same).mean() < 1e-3 and (different != true_different).mean() < 1e-3


def test_views_that_agree_add_up_and_a_majority_against_a_depth_takes_its_weight():
    view = wall(2.0)
    view.depth[:, 50:80] = 1.5
    others = [wall(2.0, 0.1), wall(2.0, -0.1), wall(2.5, 0.05)]
    checked = voted(view, others, CAMERA, 0.03, 0.1)
    np.testing.assert_allclose(checked.weights[:, 50:80], 0.4)  # three against it
    np.testing.assert_allclose(checked.weights[:, 20:40], 12.0)  # two for it, one against it
    np.testing.assert_array_equal(checked.depth, view.depth)
    assert voted(view, [], CAMERA, 0.03, 0.1) is view


def test_a_tie_leaves_a_depth_the_weight_of_those_that_agree():
    checked = voted(wall(2.0), [wall(2.0, 0.1), wall(2.5, -0.05)], CAMERA, 0.03, 0.1)
    np.testing.assert_allclose(checked.weights[:, 20:40], 8.0)
