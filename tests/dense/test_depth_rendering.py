# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import DelaunayConfig, DepthRenderingConfig
from vitamin3d.dense.delaunay import triangulate, unique_edges
from vitamin3d.dense.depth_rendering import DepthRenderer, depth_and_normals, is_surface, rasterize
from vitamin3d.dense.nltgv import vertex_slopes
from vitamin3d.types import ImageMesh

CONFIG = DepthRenderingConfig()
NORMAL = np.array([0.1, -0.15, 0.4])


def mesh_of(pixels, inverse_depth, triangles=((0, 1, 2),)):
    faces = np.array(triangles, np.int32)
    return ImageMesh(np.array(pixels, float), faces, unique_edges(faces), np.array(inverse_depth, float), np.ones(len(pixels)))


@pytest.mark.parametrize("size", [(23, 17), (1, 1), (40, 5)])
def test_rasterizer_equals_its_twin(size):
    rng = np.random.default_rng(3)
    pixels = rng.uniform(-4, [size[0] + 4, size[1] + 4], (12, 2))
    pixels[:4] = np.round(pixels[:4])
    triangles = rng.integers(0, 12, (9, 3)).astype(np.int32)
    layers = rng.uniform(0.2, 1.0, (12, 3))
    expected = reference.rasterize(pixels, triangles, layers, *size)
    np.testing.assert_allclose(rasterize(pixels, triangles, layers, *size), expected, rtol=2e-7, atol=1e-12)


def test_neighbouring_triangles_leave_no_gap():
    pixels = np.array([[0, 0], [20, 0], [20, 10], [0, 10], [7.3, 4.1]])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.int32)
    assert (rasterize(pixels, triangles, np.ones((5, 1)), 21, 11) > 0).all()


def test_the_nearest_surface_wins():
    pixels = np.array([[0, 0], [10, 0], [0, 10]] * 2, float)
    layers = np.array([[1.0, 5.0]] * 3 + [[2.0, 7.0]] * 3)
    for order in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        np.testing.assert_allclose(rasterize(pixels, np.array(order, np.int32), layers, 5, 5)[1, 1], [2.0, 7.0])


@pytest.mark.parametrize("pixels", [0.5, 1.0, 1.5, 9.0])
def test_the_canvas_holds_all_of_the_picture_in_as_many_pixels_as_it_may_have(pixels):
    camera = reference.EUROC
    canvas = DepthRenderer(camera, dataclasses.replace(CONFIG, canvas_pixels=pixels)).canvas
    whole = camera.canvas(CONFIG.canvas_limit)
    size = canvas.width * canvas.height
    assert size == pytest.approx(min(pixels * camera.width * camera.height, whole.width * whole.height), rel=5e-3)
    assert canvas.fx / canvas.fy == pytest.approx(camera.fx / camera.fy)
    middle = camera.ideal_in(canvas, camera.undistort(np.array([[0.0, 240.0], [751.0, 240.0], [367.0, 0.0], [367.0, 479.0]])))
    assert canvas.is_inside(middle, -1.0).all()
    assert middle[0, 0] < 0.02 * canvas.width + 20 and middle[1, 0] > 0.9 * canvas.width


@pytest.mark.parametrize(("camera", "pixels"), [(reference.SMALL, 1.0), *((reference.EUROC, pixels) for pixels in (0.3, 1.0, 9.0))])
def test_a_plane_comes_back_with_depth_normal_and_colour(camera, pixels):
    snapshot = reference.snapshot_of_plane(camera, NORMAL, 3000, np.random.default_rng(0))
    mesh = triangulate(snapshot, DelaunayConfig())
    renderer = DepthRenderer(camera, dataclasses.replace(CONFIG, canvas_pixels=pixels))
    view = renderer.render(snapshot, mesh, vertex_slopes(mesh))
    canvas, drawn = renderer.canvas, view.depth > 0
    v, u = np.nonzero(drawn)
    expected = 1.0 / (canvas.rays_from_ideal(np.stack([u, v], axis=1).astype(float)) @ NORMAL)
    np.testing.assert_allclose(view.depth[drawn], expected, rtol=1e-4)
    np.testing.assert_allclose(view.normals_cam[drawn], np.broadcast_to(-NORMAL / np.linalg.norm(NORMAL), (len(u), 3)), atol=1e-4)
    assert (view.normals_cam[~drawn] == 0).all()
    assert view.depth.shape == (canvas.height, canvas.width) and view.depth.dtype == np.float32
    assert view.color.shape == (*view.depth.shape, 3) and (np.ptp(view.color, axis=2) == 0).all() and view.color[drawn].min() >= 49
    assert drawn.mean() > 0.5
    assert view.timestamp_ns == 7 and drawn.sum() > 0.9 * camera.width * camera.height * (canvas.fx / camera.fx) ** 2


def test_nothing_is_drawn_outside_the_source_picture():
    camera = reference.EUROC
    renderer = DepthRenderer(camera, CONFIG)
    canvas = renderer.canvas
    corners = canvas.ideal_in(camera, np.array([[-1, -1], [2 * canvas.width, -1], [-1, 2 * canvas.height]]))
    snapshot = reference.snapshot_of_plane(camera, [0, 0, 0.5], 3, np.random.default_rng(0))
    mesh = mesh_of(corners, [0.5, 0.5, 0.5])
    config = dataclasses.replace(CONFIG, max_edge_ratio=10.0)
    view = DepthRenderer(camera, config).render(snapshot, mesh, np.zeros((3, 2)))
    v, u = np.nonzero(view.depth)
    ideal = canvas.ideal_in(camera, np.stack([u, v], axis=1))
    assert camera.is_inside(camera.distort(ideal), -0.05).all()  # OpenCV rounds to 1/32 pixel
    assert len(u) > 0.8 * view.depth.size  # all of the picture, which the barrel lens stretches
    assert view.depth[0, 0] == 0 and view.depth[-1, -1] == 0


def test_colour_pictures_keep_their_colour():
    snapshot = reference.snapshot_of_plane(reference.SMALL, NORMAL, 100, np.random.default_rng(0))
    color = np.random.default_rng(1).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    snapshot = dataclasses.replace(snapshot, frame=dataclasses.replace(snapshot.frame, color=color))
    mesh = triangulate(snapshot, DelaunayConfig())
    view = DepthRenderer(reference.SMALL, CONFIG).render(snapshot, mesh, vertex_slopes(mesh))
    np.testing.assert_array_equal(view.color, color)


def test_triangles_across_a_depth_edge_are_no_surface():
    pixels = [[60, 40], [70, 40], [60, 50]]
    assert is_surface(mesh_of(pixels, [1.0, 1.01, 1.0]), reference.SMALL, CONFIG)[0]
    assert not is_surface(mesh_of(pixels, [1.0, 1.4, 1.0]), reference.SMALL, CONFIG)[0]


def test_huge_triangles_are_no_surface():
    assert not is_surface(mesh_of([[0, 0], [127, 0], [0, 95]], [1.0, 1.0, 1.0]), reference.SMALL, CONFIG)[0]


def test_slant_is_the_angle_between_normal_and_ray():
    pixels = np.array([[63.4, 47.4], [63.6, 47.4], [63.5, 47.7]])
    for angle in (10.0, 40.0, 79.0, 81.0):
        normal = np.array([np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
        mesh = mesh_of(pixels, reference.SMALL.rays_from_ideal(pixels) @ normal)
        for limit in (angle - 0.3, angle + 0.3):
            assert is_surface(mesh, reference.SMALL, dataclasses.replace(CONFIG, max_slant_deg=limit))[0] == (angle < limit)


def test_empty_pixels_have_no_depth_and_no_normal():
    depth, normals = depth_and_normals(np.zeros((96, 128, 3)), reference.SMALL)
    assert not depth.any() and not normals.any() and depth.dtype == normals.dtype == np.float32


def test_shading_equals_its_twin():
    rng = np.random.default_rng(5)
    layers = np.dstack([rng.uniform(0.2, 1.0, (9, 11)), rng.uniform(-0.01, 0.01, (9, 11, 2))])
    layers[2:4] = 0.0
    depth, normals = depth_and_normals(layers, reference.SMALL)
    expected_depth, expected_normals = reference.depth_and_normals(layers, reference.SMALL)
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-6)
    np.testing.assert_allclose(normals, expected_normals, atol=1e-5)
