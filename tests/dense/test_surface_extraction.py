# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference_dense as reference

from vitamin3d.config import SurfaceConfig
from vitamin3d.dense.surface_extraction import clean, component_sizes, vertex_normals
from vitamin3d.dense.tsdf_fusion import empty_surface
from vitamin3d.types import Surface


def grid_surface(columns, rows, origin=(0.0, 0.0, 0.0), first=0):
    """A flat grid in x, y facing -z."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    vertices = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]) + origin
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = corner + columns + 1
    triangles = np.concatenate([np.stack([corner, below, corner + 1], 1), np.stack([corner + 1, below, below + 1], 1)])
    return vertices, (triangles + first).astype(np.int32)


def two_pieces():
    big, big_faces = grid_surface(10, 10)
    small, small_faces = grid_surface(2, 2, (50, 0, 0), len(big) + 1)
    vertices = np.vstack([big, [[99.0, 99.0, 99.0]], small])  # one vertex that nothing refers to
    colors = np.arange(3 * len(vertices)).reshape(-1, 3).astype(np.uint8)
    return Surface(vertices, np.vstack([small_faces, big_faces]), np.zeros_like(vertices), colors)


def test_small_pieces_and_loose_vertices_go():
    cleaned = clean(two_pieces(), SurfaceConfig(min_component_triangles=9))
    assert len(cleaned.triangles) == 200 and len(cleaned.vertices_world) == 121
    np.testing.assert_array_equal(cleaned.colors, two_pieces().colors[:121])
    np.testing.assert_array_equal(cleaned.normals_world, np.broadcast_to([0.0, 0.0, -1.0], (121, 3)))
    assert len(clean(two_pieces(), SurfaceConfig(min_component_triangles=8)).triangles) == 208


def test_collapsed_triangles_go():
    surface = two_pieces()
    surface.triangles[0] = [0, 0, 1]
    surface.triangles[1] = [0, 1, 2]  # on a line
    assert len(clean(surface, SurfaceConfig(min_component_triangles=1)).triangles) == 206


def test_nothing_stays_nothing():
    for surface, least in ((empty_surface(), 1), (two_pieces(), 10_000)):
        cleaned = clean(surface, SurfaceConfig(min_component_triangles=least))
        assert cleaned.vertices_world.shape == cleaned.normals_world.shape == (0, 3) and cleaned.triangles.shape == (0, 3)


def test_component_sizes_equal_their_twin():
    triangles = np.random.default_rng(0).integers(0, 90, (40, 3)).astype(np.int32)
    np.testing.assert_array_equal(component_sizes(triangles, 90), reference.component_sizes(triangles))


def test_vertex_normals_equal_their_twin():
    rng = np.random.default_rng(0)
    vertices, triangles = rng.standard_normal((20, 3)), rng.integers(0, 18, (30, 3))
    np.testing.assert_allclose(vertex_normals(vertices, triangles), reference.vertex_normals(vertices, triangles), atol=1e-12)
