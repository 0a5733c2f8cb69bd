# SPDX-License-Identifier: Apache-2.0
import dataclasses

import cv2
import numpy as np
import pytest
import reference
from scenes import EUROC, PINHOLE

from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.se3 import exp_se3, transform_points


def grid(camera, step=37):
    us, vs = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    return np.column_stack([us.ravel(), vs.ravel()]).astype(float)


def normalized(camera, pixels):
    return (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]


def test_distortion_equals_its_twin_and_opencv():
    pixels = grid(EUROC)
    twin = [reference.distort(p, EUROC.distortion) * [EUROC.fx, EUROC.fy] + [EUROC.cx, EUROC.cy] for p in normalized(EUROC, pixels)]
    opencv, _ = cv2.projectPoints(EUROC.rays_from_ideal(pixels), np.zeros(3), np.zeros(3), EUROC.K, np.array(EUROC.distortion))
    np.testing.assert_allclose(EUROC.distort(pixels), twin, rtol=0, atol=1e-10)
    np.testing.assert_allclose(EUROC.distort(pixels), opencv[:, 0], rtol=0, atol=1e-8)


def test_undistortion_equals_its_twin():
    pixels = grid(EUROC, 97)
    twin = [reference.undistort(p, EUROC.distortion) * [EUROC.fx, EUROC.fy] + [EUROC.cx, EUROC.cy] for p in normalized(EUROC, pixels)]
    np.testing.assert_allclose(EUROC.undistort(pixels), twin, rtol=0, atol=1e-7)


def test_every_pixel_of_the_picture_goes_back_and_forth():
    pixels = grid(EUROC, 11)
    ideal = EUROC.undistort(pixels)
    np.testing.assert_allclose(EUROC.distort(ideal), pixels, rtol=0, atol=1e-6)
    assert np.abs(ideal - pixels).max() > 50  # the corners move far


def test_beyond_the_fold_is_nan():
    folding = dataclasses.replace(EUROC, distortion=(-0.3, 0.0, 0.0, 0.0))  # nothing is distorted to more than 0.70 focal lengths
    pixels = np.array([[1e4, 1e4], [EUROC.cx, EUROC.cy], [np.nan, 3.0], [EUROC.cx + 0.71 * EUROC.fx, EUROC.cy]])
    ideal = folding.undistort(pixels)
    assert np.isnan(ideal[[0, 2, 3]]).all()
    np.testing.assert_allclose(ideal[1], [EUROC.cx, EUROC.cy], atol=1e-9)


def test_no_pixels():
    for method in (EUROC.undistort, EUROC.distort, PINHOLE.undistort):
        assert method(np.zeros((0, 2))).shape == (0, 2)


def test_a_pinhole_leaves_pixels_and_returns_a_copy():
    pixels = grid(PINHOLE)
    out = PINHOLE.undistort(pixels)
    np.testing.assert_array_equal(out, pixels)
    out[0] = -1
    assert pixels[0, 0] == 0


def test_projection_and_rays():
    points = np.array([[0.3, -0.2, 2.0], [0.0, 0.0, -1.0], [1.0, 1.0, 0.0]])
    pixels = PINHOLE.ideal_from_points(points)
    np.testing.assert_allclose(pixels[0], (PINHOLE.K @ points[0])[:2] / 2.0)
    assert np.isnan(pixels[1:]).all()
    np.testing.assert_allclose(PINHOLE.rays_from_ideal(pixels[:1])[0], points[0] / 2.0, rtol=1e-14)


def test_is_inside_has_an_inclusive_border_and_refuses_nan():
    pixels = np.array([[0, 0], [639, 479], [639.01, 0], [-0.01, 5], [np.nan, 5], [10, 10], [9.9, 10]])
    np.testing.assert_array_equal(PINHOLE.is_inside(pixels), [True, True, False, False, False, True, True])
    np.testing.assert_array_equal(PINHOLE.is_inside(pixels, 10), [False] * 5 + [True, False])


def test_the_canvas_holds_the_whole_picture():
    canvas = EUROC.canvas()
    shift = np.array([canvas.cx - EUROC.cx, canvas.cy - EUROC.cy])
    placed = EUROC.undistort(grid(EUROC, 1)) + shift
    assert canvas.is_inside(placed).all()
    assert not canvas.is_distorted
    assert (placed.min(axis=0) < 1.0).all()
    assert (placed.max(axis=0) > [canvas.width - 2, canvas.height - 2]).all()


def test_the_canvas_does_not_grow_beyond_its_limit():
    canvas = EUROC.canvas(limit=0.01)
    assert canvas.width <= EUROC.width + 2 * 8 and canvas.height <= EUROC.height + 2 * 5
    assert canvas.width > EUROC.width


def test_the_canvas_of_a_pinhole_is_itself():
    assert PINHOLE.canvas() == PINHOLE


def test_a_scaled_camera_sees_the_same_picture_in_other_pixels(rng):
    scaled = PINHOLE.scaled(0.5)
    assert (scaled.width, scaled.height) == (PINHOLE.width // 2, PINHOLE.height // 2)
    corners = np.array([[-0.5, -0.5], [PINHOLE.width - 0.5, PINHOLE.height - 0.5]])
    np.testing.assert_allclose(PINHOLE.ideal_in(scaled, corners), 0.5 * (corners + 0.5) - 0.5, atol=1e-12)
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    pixels = PINHOLE.ideal_from_points(points)
    np.testing.assert_allclose(PINHOLE.ideal_in(scaled, pixels), scaled.ideal_from_points(points), atol=1e-9)
    np.testing.assert_allclose(scaled.ideal_in(PINHOLE, scaled.ideal_from_points(points)), pixels, atol=1e-9)


@pytest.mark.parametrize("coefficients", [EUROC.distortion, (0.3, 0.1, 0.0, 0.0)], ids=["barrel", "pincushion"])
def test_the_canvas_shows_the_picture_where_it_belongs(coefficients):
    camera = dataclasses.replace(PinholeCamera(90.0, 92.0, 60.2, 45.1, 121, 93), distortion=coefficients)
    canvas = camera.canvas()
    us, vs = np.meshgrid(np.arange(121.0), np.arange(93.0))
    ramp = (40 + us + vs / 2).astype(np.float32)  # linear, so that bilinear sampling is exact
    drawn = camera.draw_on_canvas(ramp, camera.canvas_maps(canvas))
    shift = [canvas.cx - camera.cx, canvas.cy - camera.cy]
    pixels = np.array([[30.0, 20.0], [60.0, 45.0], [100.0, 70.0]])
    for (u, v), (x, y) in zip(pixels, camera.undistort(pixels) + shift, strict=True):
        np.testing.assert_allclose(reference.bilinear(drawn, x, y), 40 + u + v / 2, atol=0.3)


def test_the_canvas_is_black_outside_the_picture():
    canvas = EUROC.canvas()
    drawn = EUROC.draw_on_canvas(np.full((EUROC.height, EUROC.width), 200, np.uint8), EUROC.canvas_maps(canvas))
    assert drawn.shape == (canvas.height, canvas.width)
    assert drawn[0, canvas.width // 2] == 0 and drawn[canvas.height // 2, canvas.width // 2] == 200
    assert 0.6 < (drawn == 200).mean() < 0.95


def test_what_is_projected_is_seen_along_its_ray(rng):
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    rays = EUROC.unproject(EUROC.project(points))
    np.testing.assert_allclose(rays, points / points[:, 2:], atol=1e-9)
    assert np.isnan(EUROC.project(-points)).all()


def test_pose_jacobians_are_the_differences(rng):
    points, step = rng.uniform([-1, -1, 2], [1, 1, 5], (20, 3)), 1e-6
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = step
        ahead, back = (PINHOLE.ideal_from_points(transform_points(exp_se3(x), points)) for x in (xi, -xi))
        expected = (ahead - back) / (2 * step)
        for J, column in zip(PINHOLE.pose_jacobians(points), expected.T, strict=True):
            np.testing.assert_allclose(J[:, axis], column, rtol=1e-5, atol=1e-4)
