# SPDX-License-Identifier: Apache-2.0
"""What each of the solvers of adjust.py finds, on the scene of conftest.py."""

import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, three_cameras
from scipy.spatial.transform import Rotation

from vitamin3d.bundle_adjustment.adjust import SOLVERS, adjust_bundle, adjust_by_long_tracks
from vitamin3d.bundle_adjustment.observations import total_cost
from vitamin3d.bundle_adjustment.problem import points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.schur import adjust_schur
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.bundle_adjustment.variables import (
    Variables,
    free_slots,
    pinhole_model,
    sightings_of,
    squared_reprojection_errors,
)
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.geometry.se3 import inverse
from vitamin3d.geometry.sim3_alignment import align_sim3

SIGMA = 2.0
ITERATIONS = {"schur": 30, "subspace-accelerated": 30, "subspace": 300, "subspace-inner": 100}


@pytest.fixture(scope="module", params=list(SOLVERS))
def solved(request, start):
    return SOLVERS[request.param](start, PINHOLE, SIGMA, ITERATIONS[request.param], 1e-5)


def cost_of(problem):
    variables = Variables.of(problem, pinhole_model(PINHOLE))
    return total_cost(variables.views(free_slots(problem)), sightings_of(problem), variables.points, 1.0 / SIGMA**2)


def test_cost_and_errors_equal_their_twins():
    problem = three_cameras(1)
    problem.points_world[3, 2] = -50.0  # behind
    assert cost_of(problem) == pytest.approx(reference.robust_cost(problem, PINHOLE.intrinsics, SIGMA), rel=1e-10)
    errors = squared_reprojection_errors(problem, PINHOLE)
    rows = zip(problem.obs_camera, problem.obs_point, problem.obs_pixels, strict=True)
    twin = [reference.residual(PINHOLE.intrinsics, problem.T_cam_world[c], problem.points_world[p], u) for c, p, u in rows]
    np.testing.assert_allclose(errors, [np.inf if r is None else r @ r for r in twin], rtol=1e-9)
    assert np.isinf(errors).sum() == 3


def test_the_cost_never_rises(solved):
    _, report = solved
    assert (np.diff(report.costs) <= 0).all()
    assert report.costs[-1] < 0.2 * report.costs[0]
    assert report.converged


def test_the_reported_cost_is_the_minimised_cost(solved, start):
    problem, report = solved
    assert report.costs[0] == pytest.approx(reference.robust_cost(start, PINHOLE.intrinsics, SIGMA), rel=1e-9)
    assert report.costs[-1] == pytest.approx(reference.robust_cost(problem, PINHOLE.intrinsics, SIGMA), rel=1e-9)
    assert report.num_observations == len(start.obs_pixels)
    assert 0.4 < report.rmse_px < 0.9  # 0.5 px in each coordinate, less what the points take up


@pytest.mark.parametrize(("name", "limit"), [("schur", 0.02), ("subspace-accelerated", 0.02), ("subspace", 0.05), ("subspace-inner", 0.05)])
def test_the_truth_is_found(name, limit, scene, start):
    problem, _ = SOLVERS[name](start, PINHOLE, SIGMA, ITERATIONS[name], 1e-5)
    s, R, t = align_sim3(problem.points_world, scene.points)
    before = align_sim3(start.points_world, scene.points)
    error = np.linalg.norm(s * problem.points_world @ R.T + t - scene.points, axis=1)
    before = np.linalg.norm(before[0] * start.points_world @ before[1].T + before[2] - scene.points, axis=1)
    assert 1e-4 < np.median(error) < limit < 0.7 * np.median(before)
    centers = inverse(problem.T_cam_world)[:, :3, 3]
    assert np.linalg.norm(s * centers @ R.T + t - inverse(scene.T_cam_world)[:, :3, 3], axis=1).max() < 2 * limit


@pytest.mark.parametrize("name", list(SOLVERS))
def test_fixed_cameras_and_points_seen_once_stay(name):
    problem = three_cameras(2)
    solved, _ = SOLVERS[name](problem, PINHOLE, SIGMA, 5, 1e-5)
    np.testing.assert_array_equal(solved.T_cam_world[:2], problem.T_cam_world[:2])
    np.testing.assert_array_equal(solved.points_world[0], problem.points_world[0])
    assert (solved.T_cam_world[2] != problem.T_cam_world[2]).any()
    assert (solved.points_world[1:] != problem.points_world[1:]).any(axis=1).all()


@pytest.mark.parametrize("name", list(SOLVERS))
def test_nothing_free_moves_points_alone(name):
    problem = three_cameras(3)
    solved, report = SOLVERS[name](problem, PINHOLE, SIGMA, 5, 1e-5)
    np.testing.assert_array_equal(solved.T_cam_world, problem.T_cam_world)
    assert report.costs[-1] < report.costs[0]


@pytest.mark.parametrize("name", list(SOLVERS))
def test_the_input_is_left_alone_and_rotations_stay_rotations(name, start):
    before = start.T_cam_world.copy(), start.points_world.copy()
    solved, _ = SOLVERS[name](start, PINHOLE, SIGMA, 3, 1e-5)
    np.testing.assert_array_equal(start.T_cam_world, before[0])
    np.testing.assert_array_equal(start.points_world, before[1])
    R = solved.T_cam_world[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_the_same_twice_to_the_last_bit(name, start):
    (a, report_a), (b, report_b) = (SOLVERS[name](start, PINHOLE, SIGMA, 5, 1e-5) for _ in range(2))
    assert a.T_cam_world.tobytes() == b.T_cam_world.tobytes()
    assert a.points_world.tobytes() == b.points_world.tobytes()
    assert report_a.costs.tobytes() == report_b.costs.tobytes()


def test_the_cost_does_not_see_a_similarity_of_the_world(start):
    s, R, t = 3.7, Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([5.0, -2.0, 1.0])
    poses = start.T_cam_world.copy()
    poses[:, :3, :3] = start.T_cam_world[:, :3, :3] @ R.T
    poses[:, :3, 3] = s * start.T_cam_world[:, :3, 3] - poses[:, :3, :3] @ t
    moved = dataclasses.replace(start, T_cam_world=poses, points_world=s * start.points_world @ R.T + t)
    assert cost_of(moved) == pytest.approx(cost_of(start), rel=1e-10)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_a_point_behind_a_camera_costs_the_most_and_breaks_nothing(name):
    problem = three_cameras(1)
    problem.points_world[3, 2] = -50.0
    solved, report = SOLVERS[name](problem, PINHOLE, SIGMA, 10, 1e-5)
    assert np.isfinite(solved.points_world).all() and np.isfinite(solved.T_cam_world).all()
    assert (np.diff(report.costs) <= 0).all() and report.costs[-1] >= 3 * SIGMA**2


def test_no_iterations_change_nothing_but_measure(start):
    for solver in (adjust_schur, adjust_subspace):
        solved, report = solver(start, PINHOLE, SIGMA, 0)
        assert len(report.costs) == 1 and not report.converged
        np.testing.assert_array_equal(solved.points_world, start.points_world)


def test_the_settings_name_the_solver(start):
    for name, solver in (("schur", adjust_schur), ("subspace", adjust_subspace)):
        config = BundleAdjustmentConfig(sigma_px=1.5, keyframe_solver=name, keyframe_iterations=2, points_per_keyframe=0)
        np.testing.assert_array_equal(adjust_bundle(start, PINHOLE, config)[0].points_world, solver(start, PINHOLE, 1.5, 2)[0].points_world)


def test_cameras_and_long_tracks_first_then_the_other_points(noisy, start):
    """Cameras and chosen points as if they were the whole problem; then a sweep brings the other points near their own minimum."""
    chosen = points_of_long_tracks(start, 60)
    assert 60 < chosen.sum() < 0.7 * len(chosen)
    part, _ = adjust_schur(select_points(start, chosen), PINHOLE, SIGMA, 30)
    solved, report = adjust_by_long_tracks(start, PINHOLE, SIGMA, 60, lambda problem: adjust_schur(problem, PINHOLE, SIGMA, 30))
    np.testing.assert_array_equal(solved.camera_is_free, start.camera_is_free)
    np.testing.assert_allclose(solved.T_cam_world, part.T_cam_world, atol=1e-12)
    assert report.num_observations == len(part.obs_point)
    held = dataclasses.replace(solved, camera_is_free=np.zeros(len(solved.T_cam_world), np.bool_))
    best, _ = adjust_subspace(held, PINHOLE, SIGMA, 30, 1e-12)
    everything, _ = adjust_schur(start, PINHOLE, SIGMA, 30)
    assert cost_of(solved) < 1.1 * cost_of(best) and cost_of(solved) < 1.1 * cost_of(everything) < 0.2 * cost_of(start)


def test_no_limit_is_the_plain_solver(start):
    solved, _ = adjust_by_long_tracks(start, PINHOLE, SIGMA, 0, lambda problem: adjust_schur(problem, PINHOLE, SIGMA, 2))
    np.testing.assert_array_equal(solved.points_world, adjust_schur(start, PINHOLE, SIGMA, 2)[0].points_world)
