# SPDX-License-Identifier: Apache-2.0
"""How well landmarks determine the place of a camera."""

import numpy as np
import pytest
from scenes import PINHOLE, project

from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.localization.p3p_localization import refine_pose
from vitamin3d.localization.pose_deviation import LEAST_SIGMA_PX, position_deviation_deg

TRUTH = exp_se3(np.array([-0.5, 0.1, 0.3, 0.05, 0.2, -0.1]))
QUADRATIC_PX = 1e3
"""So wide a robust cost is the plain square."""


def room(rng, count):
    """(N, 3) in the camera frame, all over the picture, near and far."""
    return rng.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (count, 3)) * rng.uniform(3, 9, (count, 1))


def wall(rng, count):
    """A plane across the view."""
    return rng.uniform([-2.5, -2.0, 6.0], [2.5, 2.0, 6.0], (count, 3))


def corner_of_the_picture(rng, count):
    return rng.uniform([0.2, 0.1, 1], [0.4, 0.3, 1], (count, 3)) * rng.uniform(4, 6, (count, 1))


def errors_of(T, points_world, pixels):
    return np.linalg.norm(project(PINHOLE, T, points_world) - pixels, axis=1)


@pytest.mark.parametrize("scene", [room, wall, corner_of_the_picture])
@pytest.mark.parametrize(("count", "sigma_px"), [(300, 1.0), (60, 2.0)])
def test_it_is_how_much_the_place_varies_with_the_noise(rng, scene, count, sigma_px):
    """The same landmarks seen five hundred times: the camera's centre in its worst direction."""
    in_camera = scene(rng, count)
    points = (in_camera - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    exact, centers, claimed = project(PINHOLE, TRUTH, points), [], []
    for _ in range(500):
        pixels = exact + sigma_px * rng.standard_normal((count, 2))
        T = refine_pose(TRUTH, points, pixels, PINHOLE, QUADRATIC_PX, 30, 1e-9)
        centers.append(inverse(T)[:3, 3])
        claimed.append(position_deviation_deg(points @ T[:3, :3].T + T[:3, 3], errors_of(T, points, pixels), PINHOLE))
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(centers).T))[-1])
    measured = np.degrees(worst / np.median(in_camera[:, 2]))
    assert np.median(claimed) == pytest.approx(measured, rel=0.2) and 0.001 < measured < 5.0
    assert np.std(claimed) < 0.2 * measured  # each time


def test_fewer_than_six_landmarks_tell_nothing(rng):
    points, errors = room(rng, 9), np.full(9, 0.5)
    assert [position_deviation_deg(points[:n], errors[:n], PINHOLE) == 90.0 for n in (0, 1, 5, 6, 9)] == [True] * 3 + [False] * 2


def test_it_is_an_angle_whatever_the_unit_of_length(rng):
    points, errors = room(rng, 100), rng.uniform(0, 2, 100)
    expected = position_deviation_deg(points, errors, PINHOLE)
    for unit in (1e-3, 0.1, 30.0, 1e3):
        assert position_deviation_deg(unit * points, errors, PINHOLE) == pytest.approx(expected, rel=1e-6), unit


def test_it_grows_with_the_errors_but_no_picture_is_better_than_half_a_pixel(rng):
    points, ones = room(rng, 100), np.ones(100)
    least = position_deviation_deg(points, 0.0 * ones, PINHOLE)
    assert position_deviation_deg(points, np.sqrt(2) * LEAST_SIGMA_PX * ones, PINHOLE) == pytest.approx(least)
    assert position_deviation_deg(points, 4 * np.sqrt(2) * LEAST_SIGMA_PX * ones, PINHOLE) == pytest.approx(4 * least)


def test_more_landmarks_make_it_smaller(rng):
    points = room(rng, 100)
    few, many = (position_deviation_deg(p, np.zeros(len(p)), PINHOLE) for p in (points, np.tile(points, (4, 1))))
    assert many == pytest.approx(0.5 * few)


def test_landmarks_in_one_spot_tell_nearly_nothing(rng):
    spread = [0.5, 0.1, 0.01, 1e-3]
    angles = [position_deviation_deg([0.2, 0.1, 5.0] + s * rng.standard_normal((50, 3)), np.ones(50), PINHOLE) for s in spread]
    assert (np.diff(angles) >= 0).all() and angles[-1] > 20.0


def test_landmarks_on_one_line_or_in_one_point_tell_nothing():
    """A camera that goes around a line sees it as before."""
    line = np.array([[0.0, 0.0, 5.0]]) + np.linspace(-1, 1, 30)[:, None] * np.array([[1.0, 0.0, 0.0]])
    assert position_deviation_deg(line, np.ones(30), PINHOLE) > 20.0
    assert position_deviation_deg(line[:1].repeat(30, axis=0), np.ones(30), PINHOLE) > 20.0
