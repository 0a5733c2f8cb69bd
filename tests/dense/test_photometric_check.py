# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference
from scenes import texture

from vitamin3d.config import PhotometricConfig
from vitamin3d.dense.delaunay import unique_edges
from vitamin3d.dense.photometric_check import correlations, is_doubtful, photometrically_checked, triangle_numbers
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.types import DepthView, ImageMesh

CAMERA = reference.SMALL
CONFIG = PhotometricConfig()
SHAPE = (CAMERA.height, CAMERA.width)
NOWHERE = np.zeros(SHAPE, bool)
PICTURE = texture(*SHAPE, np.random.default_rng(3))


def view(x=0.0, depth=2.0):
    """A textured wall at z = 2, seen from (x, 0, 0) by a view that believes it to be at `depth`; its triangles are squares."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    at = np.clip(np.rint(u + CAMERA.fx * x / 2.0).astype(int), 0, CAMERA.width - 1)
    color = np.repeat(np.rint(PICTURE[v, at]).astype(np.uint8)[..., None], 3, axis=2)
    numbers = (v // 12 * ((CAMERA.width + 11) // 12) + u // 12 + 1).astype(np.int32)
    T, blank = inverse(exp_se3(np.array([x, 0, 0, 0, 0, 0]))), np.zeros((*SHAPE, 3), np.float32)
    return DepthView(0, T, np.full(SHAPE, depth, np.float32), blank, color, np.ones(SHAPE, np.float32), numbers)


def by_definition(one, other, is_outside, config):
    T = other.T_cam_world @ inverse(one.T_cam_world)
    pairs = {f: [] for f in range(one.doubtful.max() + 1)}
    for v, u in np.ndindex(SHAPE):
        d = one.depth[v, u]
        X = T @ [*(d * CAMERA.rays_from_ideal(np.array([[u, v]], float))[0]), 1.0]
        if d == 0 or X[2] <= 0:
            continue
        x, y = CAMERA.ideal_from_points(X[None, :3])[0]
        m, n = int(np.floor(x)), int(np.floor(y))
        if not (0 <= m < SHAPE[1] - 1 and 0 <= n < SHAPE[0] - 1) or is_outside[n : n + 2, m : m + 2].any():
            continue
        if 0 < other.depth[int(y + 0.5), int(x + 0.5)] < (1 - config.tolerance) * X[2]:
            continue
        weights = np.outer([1 - (y - n), y - n], [1 - (x - m), x - m])
        pairs[one.doubtful[v, u]].append((one.color[v, u, 1], (weights * other.color[n : n + 2, m : m + 2, 1]).sum()))
    found = np.full(len(pairs), np.nan)
    for f, values in pairs.items():
        a, b = np.array(values or [(0.0, 0.0)], float).T
        if f and len(a) >= config.min_pixels and (a.var() + b.var()) / 2 >= config.min_contrast**2:
            found[f] = ((a - a.mean()) * (b - b.mean())).mean() / np.sqrt(max(a.var(), 1) * max(b.var(), 1))
    return found


def test_correlation_is_that_of_the_definition():
    one, other = view(), view(0.13)
    one.depth[10:30, 10:60] = 1.6
    one.depth[:, :7] = 0.0
    other.depth[20:50, 30:60] = 1.0  # in front
    other.color[:12, :40] = 90  # flat
    is_outside = NOWHERE.copy()
    is_outside[-9:, :] = True
    expected, found = by_definition(one, other, is_outside, CONFIG), correlations(one, other, CAMERA, is_outside, CONFIG)
    assert 0.1 < np.isfinite(expected).mean() < 0.95
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_triangles_that_look_different_elsewhere_are_dropped():
    one, others = view(), [view(0.2), view(-0.2), view(0.3)]
    one.depth[:48, :48] = 1.2  # a web over free space
    checked = photometrically_checked(one, others, CAMERA, NOWHERE, CONFIG)
    web = np.zeros(SHAPE, bool)
    web[:48, :48] = True
    assert (checked.depth[web] == 0).mean() > 0.5
    assert (checked.depth[~web] == 0).mean() < 0.02
    np.testing.assert_array_equal(checked.weights, np.where(checked.depth > 0, one.weights, 0))


def test_nothing_is_dropped_that_nobody_doubts_or_sees():
    one = view(depth=1.2)
    sure = dataclasses.replace(one, doubtful=np.zeros((0, 0), np.int32))
    assert photometrically_checked(sure, [view(0.2)], CAMERA, NOWHERE, CONFIG) is sure
    assert photometrically_checked(one, [], CAMERA, NOWHERE, CONFIG) is one
    unseen = photometrically_checked(one, [view(0.2)], CAMERA, ~NOWHERE, CONFIG)
    np.testing.assert_array_equal(unseen.depth, one.depth)


def test_steep_and_large_triangles_are_doubtful():
    pixels = np.array([[0, 0], [10, 0], [0, 10], [200, 0]], float)
    faces = np.array([[0, 1, 2], [1, 3, 2], [0, 2, 1]], np.int32)
    flat = ImageMesh(pixels, faces, unique_edges(faces), np.ones(4), np.ones(4))
    assert is_doubtful(flat, CONFIG).tolist() == [False, True, False]
    steep = dataclasses.replace(flat, inverse_depth=np.array([1.0, 1.0, 1.3, 1.0]))
    assert is_doubtful(steep, CONFIG).tolist() == [True, True, True]


@pytest.mark.parametrize("size", [(30, 20), (5, 3)])
def test_pixels_know_their_triangle(size):
    pixels = np.array([[0, 0], [size[0], 0], [0, size[1]], [size[0], size[1]]], float)
    numbers = triangle_numbers(pixels, np.array([[0, 1, 2], [1, 3, 2]], np.int32), *size)
    assert numbers.shape == size[::-1] and set(np.unique(numbers)) == {1, 2}
    assert numbers[0, 0] == 1 and numbers[-1, -1] == 2
    assert (triangle_numbers(pixels, np.zeros((0, 3), np.int32), *size) == 0).all()
