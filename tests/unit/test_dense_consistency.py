# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference_dense as reference

from vitamin3d.dense.consistency import confirmed_by, doubted
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
    out = np.zeros(view.depth.shape, bool)
    for v, u in np.ndindex(out.shape):
        X = view.depth[v, u] * np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        for other in others:
            if view.depth[v, u] == 0:
                continue
            x, y, z, _ = other.T_cam_world @ inverse(view.T_cam_world) @ [*X, 1.0]
            m, n = (int(np.floor(value + 0.5)) for value in (CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy))
            if 0 <= m < CAMERA.width and 0 <= n < CAMERA.height:
                out[v, u] |= abs(other.depth[n, m] - z) < tolerance * z
    return out


def test_confirmed_is_what_the_definition_says():
    rng = np.random.default_rng(0)
    views = [wall(2.0, x) for x in (0.0, 0.21, -0.17)]
    for view in views:
        view.depth[:] *= rng.uniform(0.93, 1.07, view.depth.shape).astype(np.float32)
        view.depth[rng.uniform(size=view.depth.shape) < 0.1] = 0.0
    ours, theirs = confirmed_by(views[0], views[1:], CAMERA, 0.03), by_definition(views[0], views[1:], 0.03)
    assert 0.3 < theirs.mean() < 0.9
    assert (ours != theirs).mean() < 1e-3


def test_what_nobody_confirms_loses_weight_and_nothing_else():
    view = wall(2.0)
    view.depth[:, :40] = 1.5
    checked = doubted(view, [wall(2.0, 0.1)], CAMERA, 0.03, 0.1)
    np.testing.assert_allclose(checked.weights[:, :40], 0.4)
    np.testing.assert_allclose(checked.weights[:, 50:], 4.0)
    np.testing.assert_array_equal(checked.depth, view.depth)
    assert doubted(view, [], CAMERA, 0.03, 0.1) is view
