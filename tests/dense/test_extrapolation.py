# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import DelaunayConfig, ExtrapolationConfig
from vitamin3d.dense.delaunay import triangulate
from vitamin3d.dense.extrapolation import extended, nearest, outline
from vitamin3d.dense.nltgv import vertex_slopes

CAMERA, CONFIG, NORMAL = reference.SMALL, ExtrapolationConfig(spacing_px=16.0), np.array([0.1, 0.2, 0.5])


@pytest.fixture
def mesh():
    """A plane, landmarks in the middle of the picture only."""
    snapshot = reference.snapshot_of_plane(CAMERA, NORMAL, 300, np.random.default_rng(0))
    inner = (np.abs(snapshot.pixels - [63.5, 47.5]) < [44, 30]).all(axis=1)
    kept = {name: getattr(snapshot, name)[inner] for name in ("pixels", "depths", "relative_deviations")}
    return triangulate(dataclasses.replace(snapshot, **kept), DelaunayConfig(min_vertices=10))


def area(mesh):
    a, b, c = (mesh.pixels[mesh.triangles[:, k]] for k in range(3))
    return 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()


def test_a_plane_is_continued_to_the_border_of_the_picture(mesh):
    border, slopes = outline(CAMERA, 16.0), vertex_slopes(mesh)
    whole, new_slopes = extended(mesh, slopes, border, CONFIG)
    assert area(mesh) < 0.45 * 127 * 95 and area(whole) == pytest.approx(127 * 95)
    np.testing.assert_allclose(whole.inverse_depth, CAMERA.rays_from_ideal(whole.pixels) @ NORMAL, rtol=1e-9)
    np.testing.assert_array_equal(whole.inverse_depth[: len(mesh.pixels)], mesh.inverse_depth)
    np.testing.assert_array_equal(whole.edges, reference.edges_of(whole.triangles))
    assert len(new_slopes) == len(whole.pixels) == len(whole.relative_deviation)


def test_deviations_grow_with_the_distance(mesh):
    whole, _ = extended(mesh, vertex_slopes(mesh), outline(CAMERA, 16.0), CONFIG)
    new = slice(len(mesh.pixels), None)
    distance = np.linalg.norm(whole.pixels[new, None] - mesh.pixels, axis=2).min(axis=1)
    np.testing.assert_allclose(whole.relative_deviation[new], mesh.relative_deviation[0] * (1 + distance / 64.0), rtol=1e-6)
    assert distance.min() > 10


def test_what_would_end_far_off_is_left_out(mesh):
    steep = np.tile([0.5, 0.0], (len(mesh.pixels), 1))
    whole, _ = extended(mesh, steep, outline(CAMERA, 16.0), CONFIG)
    assert (whole.inverse_depth > 0).all() and len(whole.pixels) < len(mesh.pixels) + 8


def test_the_outline_is_the_undistorted_border():
    border = outline(reference.EUROC, 40.0)
    back = reference.EUROC.distort(border)
    on_border = [np.isclose(back[:, k], end, atol=1e-3) for k, end in ((0, 0), (0, 751), (1, 0), (1, 479))]
    assert np.any(on_border, axis=0).all() and 55 < len(border) < 65


def test_the_nearest_are_those_of_the_twin():
    rng = np.random.default_rng(1)
    points, queries = rng.uniform(0, 100, (300, 2)), rng.uniform(-20, 120, (40, 2))
    gaps = np.linalg.norm(queries[:, None] - points, axis=2)
    distance, near = nearest(points, queries, 8)
    np.testing.assert_array_equal(near, np.argsort(gaps, axis=1)[:, :8])
    np.testing.assert_allclose(distance, np.sort(gaps, axis=1)[:, :8], rtol=1e-12)
    assert nearest(points[:1], queries, 1)[1].max() == 0
