# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.dense.marching_cubes import EMPTY, SIDE, Blocks, triangle_table, zero_level

VOXEL = 0.25
FIRST = np.array([-2, 0, 3])
"""Key of the first block."""


def field(seed, extent=(2, 2, 2)):
    """Random distances, what is known of them, and colours, indexed [x, y, z]."""
    rng = np.random.default_rng(seed)
    shape = tuple(SIDE * n for n in extent)
    return rng.uniform(-1, 1, shape).astype(np.float32), rng.random(shape) < 0.97, rng.uniform(0, 255, (*shape, 3)).astype(np.float32)


def blocks_of(distance, is_known, color):
    """The fields cut into blocks, which come in no order."""
    extent = [n // SIDE for n in distance.shape]
    keys = np.array(list(itertools.product(*map(range, extent))))[::-1]
    row = {tuple(key): n for n, key in enumerate(keys)}
    near = np.array([[row.get((x + (k & 1), y + (k >> 1 & 1), z + (k >> 2)), EMPTY) for k in range(8)] for x, y, z in keys])

    def cut(values, kind):
        parts = [values[tuple(slice(SIDE * n, SIDE * (n + 1)) for n in key)] for key in keys]
        return np.array([part.swapaxes(0, 2).reshape(SIDE**3, *part.shape[3:]) for part in parts]).astype(kind)

    return Blocks(keys + FIRST, near, cut(distance, np.float32), cut(is_known, np.float32), cut(color, np.float32))


def surface(seed=0, extent=(2, 2, 2)):
    fields = field(seed, extent)
    return zero_level(blocks_of(*fields), 0.5, VOXEL), fields


def test_corners_are_where_the_sign_changes():
    (vertices, _, colors), fields = surface()
    expected = reference.zero_crossings(*fields)
    rows = np.column_stack([vertices / VOXEL - SIDE * FIRST, colors])
    assert len(rows) == len(expected) > 1000
    order, expected_order = (np.lexsort(np.round(r[:, 2::-1], 4).T) for r in (rows, expected))
    np.testing.assert_allclose(rows[order], expected[expected_order], atol=1e-3)


def test_the_surface_has_no_holes_where_everything_is_known():
    distance, is_known, color = field(1)
    distance[[0, -1]], distance[:, [0, -1]], distance[:, :, [0, -1]] = 1.0, 1.0, 1.0
    _, triangles, _ = zero_level(blocks_of(distance, np.ones_like(is_known), color), 0.5, VOXEL)
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there, back = (np.unique(pairs, axis=0, return_counts=True) for pairs in (directed, directed[:, ::-1]))
    assert there[1].max() == 1 and len(triangles) > 1000
    np.testing.assert_array_equal(there[0], back[0])


def test_all_cubes_have_the_corners_of_their_signs():
    count, edges = triangle_table()
    for code in range(256):
        sides = [code >> corner & 1 for corner in range(8)]
        crossed = {3 * c + axis for c in range(8) for axis in range(3) if not c >> axis & 1 and sides[c] != sides[c | 1 << axis]}
        assert set(edges[code, : count[code]].ravel().tolist()) == crossed
    assert count.max() == 5 and count.sum() == 820  # as in the usual table


def test_the_order_depends_on_places_alone():
    fields = field(2)
    one = blocks_of(*fields)
    order = np.random.default_rng(0).permutation(len(one.keys))
    place = np.append(np.argsort(order), EMPTY)
    other = Blocks(one.keys[order], place[one.near[order]], one.distance[order], one.weight[order], one.shade[order])
    for a, b in zip(zero_level(one, 0.5, VOXEL), zero_level(other, 0.5, VOXEL), strict=True):
        np.testing.assert_array_equal(a, b)


def test_triangles_face_the_positive_side():
    distance = np.broadcast_to(3.3 - np.arange(16.0, dtype=np.float32), (16, 16, 16))  # positive before z = 3.3
    vertices, triangles, _ = zero_level(blocks_of(distance, np.ones_like(distance), np.zeros((16, 16, 16, 3))), 0.5, VOXEL)
    np.testing.assert_allclose(vertices[:, 2], VOXEL * (3.3 + SIDE * FIRST[2]), atol=1e-6)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    assert len(triangles) == 2 * 15 * 15 and (np.cross(b - a, c - a)[:, 2] < 0).all()


@pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
def test_as_open3d_extracts():
    import open3d as o3d

    (vertices, triangles, _), fields = surface(3)
    blocks = blocks_of(*fields)
    single = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (single, single, single), ((1), (1), (3)), VOXEL, SIDE, 8, device=o3d.core.Device("CPU:0")
    )
    rows = grid.hashmap().activate(o3d.core.Tensor(blocks.keys.astype(np.int32)))[0].numpy().astype(np.int64)
    for name, values in (("tsdf", blocks.distance), ("weight", blocks.weight), ("color", blocks.shade)):
        grid.attribute(name).numpy()[rows] = values.reshape(-1, SIDE, SIDE, SIDE, values.size // blocks.distance.size)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    theirs = mesh.vertex.positions.numpy()
    assert len(theirs) == len(vertices) and len(mesh.triangle.indices) == len(triangles)
    np.testing.assert_allclose(np.sort(theirs, axis=0), np.sort(vertices, axis=0), atol=1e-5)
