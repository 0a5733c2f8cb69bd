# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, perturbed, problem_of

from vitamin3d.bundle_adjustment.adjust import AdjustmentSettings, adjust
from vitamin3d.bundle_adjustment.marginalization import marginalize
from vitamin3d.bundle_adjustment.schur import ReducedSystem
from vitamin3d.bundle_adjustment.variables import Variables, free_slots, pinhole_model, sightings_of
from vitamin3d.geometry.se3 import exp_se3

MODEL = pinhole_model(PINHOLE)
SIGMA = 2.0
GONE = np.array([False, True, True, False, False, False])
"""Of six cameras, the first and the last of which are fixed."""


def noisy(seed=0, num_points=60):
    """The first half of the points is seen by the cameras that go, the second half by the others only."""
    rng = np.random.default_rng(seed)
    scene = arc_scene(6, num_points, rng)
    keep = (scene.obs_point < num_points // 2) | (scene.obs_camera > 2)
    pixels = scene.pixels[keep] + 0.4 * rng.standard_normal((keep.sum(), 2))
    scene = dataclasses.replace(scene, obs_camera=scene.obs_camera[keep], obs_point=scene.obs_point[keep], pixels=pixels)
    poses, points = perturbed(scene, rng, 0.002, 0.01)
    is_free = np.array([False, True, True, True, True, False])
    poses[5] = scene.T_cam_world[5]
    return dataclasses.replace(problem_of(scene, 1, poses, points), camera_is_free=is_free)


def test_the_first_step_is_that_of_the_full_problem():
    """Cameras eliminated or not, a Gauss–Newton step of the others is the same; against dense matrices."""
    problem = noisy()
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    step = -np.linalg.solve(H + 1e-10 * np.diag(np.diag(H)), g)
    left, prior = marginalize(problem, MODEL, GONE, SIGMA)
    assert len(left.T_cam_world) == 4 and len(left.points_world) == 30 and prior.cameras.tolist() == [1, 2]
    system = ReducedSystem(sightings_of(left), free_slots(left), SIGMA)
    system.camera_prior = prior
    moved = system.step(Variables.of(left, MODEL), 1e-10).moved
    for number, old in ((1, 3), (2, 4)):
        xi = step[6 * (old - 1) : 6 * old]
        expected = exp_se3(xi) @ problem.T_cam_world[old]
        np.testing.assert_allclose(moved.R[number], expected[:3, :3], atol=1e-7)
        np.testing.assert_allclose(moved.t[number], expected[:3, 3], atol=1e-6)
    free_points = step[24:].reshape(-1, 3)
    np.testing.assert_allclose(moved.points - left.points_world, free_points[30:], atol=1e-6)


def test_at_its_minimum_a_problem_stays_there_when_cameras_leave():
    settings = AdjustmentSettings("schur", SIGMA, iterations=100, relative_gain=1e-14)
    best = adjust(noisy(), MODEL, settings).problem
    left, prior = marginalize(best, MODEL, GONE, SIGMA)
    kicked = left.T_cam_world.copy()
    kicked[2] = exp_se3(np.array([0.01, -0.01, 0.01, 0.003, 0.002, -0.003])) @ kicked[2]
    solved = adjust(dataclasses.replace(left, T_cam_world=kicked), MODEL, settings, prior).problem
    without = adjust(dataclasses.replace(left, T_cam_world=kicked), MODEL, settings).problem
    np.testing.assert_allclose(solved.T_cam_world, left.T_cam_world, atol=2e-4)
    assert np.abs(without.T_cam_world - left.T_cam_world).max() > 10 * np.abs(solved.T_cam_world - left.T_cam_world).max()


def test_the_prior_costs_nothing_where_it_was_made_and_its_gradient_is_right():
    problem = noisy(3)
    left, prior = marginalize(problem, MODEL, GONE, SIGMA)
    R, t = left.T_cam_world[:, :3, :3].copy(), left.T_cam_world[:, :3, 3].copy()
    assert prior.cost(R, t) == pytest.approx(0.0, abs=1e-9)
    far = np.array([exp_se3(0.05 * np.sin(np.arange(6) + k)) @ T for k, T in enumerate(left.T_cam_world)])
    H, g = np.zeros((12, 12)), np.zeros(12)
    prior.add_to(far[:, :3, :3], far[:, :3, 3], free_slots(left), 0.0, H, g)

    def cost(delta):
        poses = far.copy()
        for n in range(2):
            poses[n + 1] = exp_se3(delta[6 * n : 6 * n + 6]) @ poses[n + 1]
        return prior.cost(poses[:, :3, :3], poses[:, :3, 3])

    numeric = np.array([(cost(1e-5 * d) - cost(-1e-5 * d)) / 2e-5 for d in np.eye(12)])
    np.testing.assert_allclose(2 * g, numeric, atol=1e-5 * np.abs(numeric).max())


def test_a_prior_is_handed_on():
    """Two cameras at once or one after the other: the same prior."""
    problem = noisy(5)
    _, both = marginalize(problem, MODEL, GONE, SIGMA)
    first = np.array([False, True, False, False, False, False])
    left, prior = marginalize(problem, MODEL, first, SIGMA)
    _, handed = marginalize(left, MODEL, np.array([False, True, False, False, False]), SIGMA, prior)
    np.testing.assert_array_equal(handed.cameras, both.cameras)
    scale = np.abs(both.information).max()
    np.testing.assert_allclose(handed.information, both.information, atol=1e-6 * scale)
    np.testing.assert_allclose(handed.gradient, both.gradient, atol=1e-6 * np.abs(both.gradient).max())


def test_the_prior_is_symmetric_and_has_no_negative_direction():
    _, prior = marginalize(noisy(8), MODEL, GONE, SIGMA)
    np.testing.assert_array_equal(prior.information, prior.information.T)
    assert np.linalg.eigvalsh(prior.information).min() > -1e-7 * np.abs(prior.information).max()
