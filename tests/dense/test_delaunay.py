# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import DelaunayConfig
from vitamin3d.dense.delaunay import separate_in_order, triangulate, unique_edges

CONFIG = DelaunayConfig(min_vertices=10)


@pytest.fixture
def snapshot():
    return reference.snapshot_of_plane(reference.SMALL, [0.1, 0.2, 0.5], 200, np.random.default_rng(0))


def test_mesh_covers_the_convex_hull_with_the_landmarks(snapshot):
    mesh = triangulate(snapshot, CONFIG)
    a, b, c = (mesh.pixels[mesh.triangles[:, k]] for k in range(3))
    areas = 0.5 * np.abs(np.cross(np.column_stack([b - a, 0 * a[:, 0]]), np.column_stack([c - a, 0 * a[:, 0]]))[:, 2])
    assert 0.9 * 127 * 95 < areas.sum() <= 127 * 95
    rays = reference.SMALL.rays_from_ideal(mesh.pixels)
    np.testing.assert_allclose(mesh.inverse_depth, rays @ [0.1, 0.2, 0.5], rtol=1e-12)


def test_edges_are_those_of_the_twin(snapshot):
    mesh = triangulate(snapshot, CONFIG)
    np.testing.assert_array_equal(mesh.edges, reference.edges_of(mesh.triangles))
    assert len(mesh.pixels) - len(mesh.edges) + len(mesh.triangles) == 1  # Euler, without the outer face
    assert len(unique_edges(np.zeros((0, 3), np.int32))) == 0


def test_the_more_certain_of_two_close_landmarks_stays(snapshot):
    twice = dataclasses.replace(
        snapshot,
        pixels=np.vstack([snapshot.pixels, snapshot.pixels + 0.1]),
        depths=np.concatenate([snapshot.depths, 2 * snapshot.depths]),
        relative_deviations=np.concatenate([snapshot.relative_deviations, 0.5 * snapshot.relative_deviations]),
    )
    mesh = triangulate(twice, CONFIG)
    rays = reference.SMALL.rays_from_ideal(mesh.pixels - 0.1)
    np.testing.assert_allclose(mesh.inverse_depth, 0.5 * rays @ [0.1, 0.2, 0.5], rtol=1e-9)
    assert len(mesh.pixels) <= 200
    gaps = np.linalg.norm(mesh.pixels[mesh.edges[:, 0]] - mesh.pixels[mesh.edges[:, 1]], axis=1)
    assert gaps.min() >= CONFIG.min_separation_px


def test_weights_are_the_inverse_of_the_deviation_up_to_a_limit(snapshot):
    deviations = np.where(np.arange(200) % 2, 0.1, 1e-6)
    mesh = triangulate(dataclasses.replace(snapshot, relative_deviations=deviations), CONFIG)
    np.testing.assert_allclose(np.unique(np.round(mesh.relative_deviation, 9)), [0.01, np.hypot(0.1, 0.01)], rtol=1e-5)


def test_useless_landmarks_are_left_out(snapshot):
    depths, deviations = snapshot.depths.copy(), snapshot.relative_deviations.copy()
    depths[:3], deviations[3] = [np.nan, -1.0, 0.0], np.nan
    mesh = triangulate(dataclasses.replace(snapshot, depths=depths, relative_deviations=deviations), CONFIG)
    assert np.isfinite(mesh.inverse_depth).all() and (mesh.inverse_depth > 0).all() and np.isfinite(mesh.relative_deviation).all()


def test_too_few_landmarks_make_no_mesh(snapshot):
    assert triangulate(snapshot, DelaunayConfig(min_vertices=201)) is None
    empty = dataclasses.replace(snapshot, pixels=np.zeros((0, 2)), depths=np.zeros(0), relative_deviations=np.zeros(0))
    assert triangulate(empty, CONFIG) is None


def test_landmarks_on_a_line_make_no_mesh(snapshot):
    line = dataclasses.replace(snapshot, pixels=np.stack([np.arange(200.0) * 2, np.full(200, 3.0)], axis=1))
    assert triangulate(line, CONFIG) is None


@pytest.mark.parametrize("distance", [0.5, 3.0, 25.0])
def test_separation_equals_its_twin(distance):
    rng = np.random.default_rng(7)
    pixels, deviations = rng.uniform(0, [127, 95], (400, 2)), rng.integers(1, 4, 400) / 100.0
    pixels[1] = pixels[0]
    gaps = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    worse = (deviations[:, None] > deviations) | ((deviations[:, None] == deviations) & np.tri(400, k=-1, dtype=bool))
    expected = np.flatnonzero(~((gaps <= distance) & worse).any(axis=1))
    assert 2 <= len(expected) < 400
    np.testing.assert_array_equal(np.sort(separate_in_order(pixels, deviations, distance)), expected)


def test_neighbours_in_the_picture_are_neighbours_in_memory():
    pixels = np.random.default_rng(8).uniform(0, [752, 480], (10_000, 2))
    chosen = separate_in_order(pixels, np.full(10_000, 0.01), 0.5)
    step = np.linalg.norm(np.diff(pixels[chosen], axis=0), axis=1)
    assert np.median(step) < 10 and step.max() < 60
