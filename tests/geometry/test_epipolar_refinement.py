# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import PINHOLE, direction_error_deg, two_views

from vitamin3d.geometry.epipolar_refinement import DIRECTIONS, refine_essential, sampson_distances
from vitamin3d.geometry.essential import relative_pose
from vitamin3d.geometry.se3 import exp_se3, skew

T_1_0 = exp_se3(np.array([-0.5, 0.1, 0.15, 0.03, 0.12, -0.05]))
LITTLE_PARALLAX = exp_se3(np.array([-0.03, 0.05, 0.02, 0.01, 0.04, -0.03]))


def rays(*pixels):
    return [PINHOLE.rays_from_ideal(p) for p in pixels]


def direction_of(E):
    """Up to its sign: the null vector of Eᵀ."""
    return np.linalg.svd(E.T)[2][-1]


def angle_deg(a, b):
    """Between two axes, whatever their signs."""
    angle = direction_error_deg(a, b)
    return min(angle, 180.0 - angle)


def test_the_distance_is_the_first_order_one_of_the_epipolar_constraint(rng):
    E = skew(T_1_0[:3, 3]) @ T_1_0[:3, :3]
    _, *pixels = two_views(T_1_0, rng, 20, 1.0)
    rays_0, rays_1 = rays(*pixels)
    expected = []
    for x_0, x_1 in zip(rays_0, rays_1, strict=True):
        gradient = np.array([(E @ x_0)[0], (E @ x_0)[1], (E.T @ x_1)[0], (E.T @ x_1)[1]])
        expected.append(x_1 @ E @ x_0 / np.sqrt(gradient @ gradient))
    np.testing.assert_allclose(sampson_distances(E, rays_0, rays_1), expected, rtol=1e-12)


def test_no_two_directions_are_opposite_or_the_same():
    unit = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    assert len(DIRECTIONS) == 13 and np.isfinite(unit).all()
    assert (np.abs(unit @ unit.T) - np.eye(13)).max() < 0.9


@pytest.mark.parametrize("start", [[1.0, 0, 0], [0, 0, 1.0], [0.2, 1.0, -0.4], [-0.2, -0.3, 1.0]])
def test_every_start_ends_at_the_motion_of_the_scene(start, rng):
    _, *pixels = two_views(T_1_0, rng)
    rays_0, rays_1 = rays(*pixels)
    E = refine_essential(np.eye(3), np.array(start), rays_0, rays_1, 1.0 / PINHOLE.fx)
    assert angle_deg(direction_of(E), T_1_0[:3, 3]) < 1.5
    assert np.median(np.abs(sampson_distances(E, rays_0, rays_1))) * PINHOLE.fx < 0.3


def test_outliers_do_not_move_it(rng):
    _, *pixels = two_views(T_1_0, rng)
    rays_0, rays_1 = rays(*pixels)
    rays_1[:60, :2] = rng.uniform(-0.5, 0.5, (60, 2))
    E = refine_essential(T_1_0[:3, :3], np.array([0.0, 0, 1]), rays_0, rays_1, 1.0 / PINHOLE.fx)
    assert angle_deg(direction_of(E), T_1_0[:3, 3]) < 2.0


def test_with_little_parallax_the_cost_is_never_above_that_at_the_true_motion(rng):
    """RANSAC alone ends above it in about every third of these scenes."""

    def cost(E, rays_0, rays_1):
        squared = (sampson_distances(E, rays_0, rays_1) * PINHOLE.fx) ** 2
        return (squared / (1.0 + squared)).sum()

    truth, errors = skew(LITTLE_PARALLAX[:3, 3]) @ LITTLE_PARALLAX[:3, :3], []
    for _ in range(12):
        _, *pixels = two_views(LITTLE_PARALLAX, rng, sigma_px=0.6)
        both = rays(*pixels)
        view = relative_pose(*pixels, PINHOLE, 1.0)
        found = skew(view.T_1_0[:3, 3]) @ view.T_1_0[:3, :3]
        assert cost(found, *both) <= cost(truth, *both)
        errors.append(angle_deg(view.T_1_0[:3, 3], LITTLE_PARALLAX[:3, 3]))
    assert max(errors) < 15.0 and np.median(errors) < 8.0
