# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.dense.fused_views import CODES, FREE, RUN, FusedViews
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import DepthView

CAMERA = reference.SMALL
TRUNCATION = 0.2
MUCH = 1e9


def random_view(rng, is_grey):
    """Depths of 1 to 3 in patches, a tenth of them missing, seen from near the origin."""
    depth = rng.uniform(1.0, 3.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    color = rng.integers(0, 256, (*depth.shape, 3)).astype(np.uint8)
    if is_grey:
        color[...] = color[..., :1]
    T_cam_world = exp_se3(rng.normal(0.0, 0.2, 6))
    return DepthView(0, T_cam_world, depth, np.zeros((0, 0, 3), np.float32), color, np.ones_like(depth))


def look(view, point):
    """Signed distance of a point in truncations and the colour of its pixel; None: the view does not see it."""
    x, y, z = view.T_cam_world[:3, :3] @ point + view.T_cam_world[:3, 3]
    if z <= 0:
        return None
    u, v = int(np.floor(CAMERA.fx * x / z + CAMERA.cx + 0.5)), int(np.floor(CAMERA.fy * y / z + CAMERA.cy + 0.5))
    if not (0 <= u < CAMERA.width and 0 <= v < CAMERA.height) or view.depth[v, u] == 0:
        return None
    signed = (view.depth[v, u] - z) * np.sqrt((x / z) ** 2 + (y / z) ** 2 + 1) / TRUNCATION
    return None if signed <= -1 else (min(signed, 1.0), view.color[v, u].astype(float))


def expected(views, point):
    """Mean distance and colour, NaN and 0 where no view sees the point."""
    looks = [found for found in (look(view, point) for view in views) if found is not None]
    if not looks:
        return np.nan, np.zeros(3)
    weights = [1.0 if signed < 1 else FREE for signed, _ in looks]
    return np.mean([signed for signed, _ in looks]), np.average([color for _, color in looks], axis=0, weights=weights)


def kept(views, max_bytes=MUCH):
    made = FusedViews(CAMERA, max_bytes)
    for view in views:
        made.add(view, view.depth)
    return made


@pytest.mark.parametrize("spread", [0.02, 1.5])
@pytest.mark.parametrize("greys", [(True, True, True), (False, False, False), (True, False, True)])
def test_points_are_seen_as_by_the_obvious_way(rng, greys, spread):
    """`spread` of the points in a row: within the picture together, or most of them outside."""
    views = [random_view(rng, is_grey) for is_grey in greys]
    middles = np.repeat(rng.uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 3.5], (20, 3)), RUN, axis=0)[: 20 * RUN - 5]
    points = (middles + rng.uniform(-spread, spread, middles.shape)).astype(np.float32)
    seen = kept(views).seen(np.ascontiguousarray(points.T), TRUNCATION)
    distances, colors = zip(*(expected(views, point) for point in points.astype(float)), strict=True)
    is_same = np.isclose(seen.distance, distances, atol=2e-3, equal_nan=True)
    assert is_same.mean() > 0.995  # single precision may choose the pixel beside, or the other side of the truncation
    assert 0.05 < seen.is_seen.mean() < 0.95
    np.testing.assert_allclose(seen.colors[is_same], np.array(colors)[is_same], atol=1.0)


def test_a_kept_depth_is_exact_to_a_step(rng):
    view = random_view(rng, True)
    seen_at = FusedViews(CAMERA, MUCH)
    seen_at.add(view, view.depth)
    v, u = np.nonzero(view.depth)
    rays = CAMERA.rays_from_ideal(np.column_stack([u, v]).astype(float))
    points_cam = (view.depth[v, u, None] - 0.01) * rays
    points = (points_cam - view.T_cam_world[:3, 3]) @ view.T_cam_world[:3, :3]
    seen = seen_at.seen(np.ascontiguousarray(points.T, np.float32), TRUNCATION)
    error = seen.distance * TRUNCATION / np.linalg.norm(rays, axis=1) - 0.01
    assert np.abs(error).max() < view.depth.max() / CODES + 1e-5


def test_with_enough_views_no_more_are_asked(rng):
    views = []
    for brightness in range(16):
        view = random_view(rng, True)
        view.color[...], view.depth[...], view.T_cam_world[...] = brightness, 2.0, np.eye(4)
        views.append(view)
    points = np.tile(np.array([[0.0], [0.0], [1.99]], np.float32), 100)
    assert (kept(views).seen(points, TRUNCATION, enough=2).colors == 4).all()  # of the first and the ninth view
    assert (kept(views).seen(points, TRUNCATION, enough=4).colors == 6).all()  # and of the fifth and the thirteenth
    assert (kept(views).seen(points, TRUNCATION).colors == 8).all()


def test_every_second_view_is_dropped_where_there_is_no_room(rng):
    views = [random_view(rng, True) for _ in range(20)]
    one = kept(views[:1]).num_bytes
    made = kept(views, 5.5 * one)
    assert len(made) == 5 and made.num_bytes <= 5.5 * one
    for view, packed in zip(views[::4], made._kept, strict=True):
        np.testing.assert_array_equal(packed.color[..., 0], view.color[..., 0])


def test_a_view_without_depth_sees_nothing(rng):
    view = random_view(rng, True)
    view.depth[...] = 0.0
    assert not kept([view]).seen(np.array([[0.0], [0.0], [1.0]], np.float32), TRUNCATION).is_seen.any()


def test_no_views_see_nothing():
    seen = FusedViews(CAMERA, MUCH).seen(np.zeros((3, 10), np.float32), TRUNCATION)
    assert not seen.is_seen.any() and not seen.colors.any()
    assert kept([]).seen(np.zeros((3, 0), np.float32), TRUNCATION).distance.shape == (0,)
