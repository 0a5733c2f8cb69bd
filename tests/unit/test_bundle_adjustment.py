# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, perturbed, problem_of, with_noise
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from vitamin3d.bundle_adjustment import subspace
from vitamin3d.bundle_adjustment.adjust import SOLVERS, adjust_bundle, adjust_by_long_tracks
from vitamin3d.bundle_adjustment.observations import total_cost
from vitamin3d.bundle_adjustment.problem import points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.schur import ReducedSystem, adjust_schur
from vitamin3d.bundle_adjustment.subspace import adjust_subspace, new_scratch, sweep_cameras, sweep_points
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


@pytest.fixture(scope="module")
def noisy(scene):
    return with_noise(scene, np.random.default_rng(5))[0]


@pytest.fixture(scope="module")
def start(noisy):
    poses, points = perturbed(noisy, np.random.default_rng(6))
    return problem_of(noisy, poses=poses, points=points)


@pytest.fixture(scope="module", params=list(SOLVERS))
def solved(request, start):
    return SOLVERS[request.param](start, PINHOLE, SIGMA, ITERATIONS[request.param], 1e-5)


def small(num_fixed, seed=2):
    """Three cameras, fourteen points (the first seen once), perturbed."""
    rng = np.random.default_rng(seed)
    scene = arc_scene(3, 14, rng)
    keep = (scene.obs_point != 0) | (scene.obs_camera == 1)
    pixels = scene.pixels[keep] + rng.normal(0, 1, (keep.sum(), 2))
    scene = dataclasses.replace(scene, obs_camera=scene.obs_camera[keep], obs_point=scene.obs_point[keep], pixels=pixels)
    poses, points = perturbed(scene, rng, 0.005, 0.02)
    return problem_of(scene, num_fixed, poses, points)


def cost_of(problem):
    variables = Variables.of(problem, pinhole_model(PINHOLE))
    return total_cost(variables.views(free_slots(problem)), sightings_of(problem), variables.points, 1.0 / SIGMA**2)


def test_cost_and_errors_equal_their_twins():
    problem = small(1)
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


def test_schur_reaches_the_minimum_that_scipy_finds(start):
    mine, _ = adjust_schur(start, PINHOLE, SIGMA, 60)
    theirs = scipy_minimum(start)
    assert reference.robust_cost(mine, PINHOLE.intrinsics, SIGMA) == pytest.approx(theirs, rel=1e-4)


def scipy_minimum(problem):
    """The smallest cost of the same objective by trust-region least squares on r sigma / sqrt(r² + sigma²)."""
    C, P, M = len(problem.T_cam_world), len(problem.points_world), len(problem.obs_pixels)
    fx, fy, cx, cy = PINHOLE.intrinsics
    fixed = problem.T_cam_world[0]

    def residuals(x):
        poses = x[: 6 * (C - 1)].reshape(-1, 6)
        R = np.concatenate([fixed[None, :3, :3], Rotation.from_rotvec(poses[:, :3]).as_matrix()])
        t = np.vstack([fixed[:3, 3], poses[:, 3:]])
        X = np.einsum("mij,mj->mi", R[problem.obs_camera], x[6 * (C - 1) :].reshape(-1, 3)[problem.obs_point]) + t[problem.obs_camera]
        r = np.column_stack([fx * X[:, 0] / X[:, 2] + cx, fy * X[:, 1] / X[:, 2] + cy]) - problem.obs_pixels
        return (r * (SIGMA / np.sqrt((r**2).sum(axis=1, keepdims=True) + SIGMA**2))).ravel()

    sparsity = lil_matrix((2 * M, 6 * (C - 1) + 3 * P), dtype=int)
    for i, (c, p) in enumerate(zip(problem.obs_camera, problem.obs_point, strict=True)):
        at = 6 * (C - 1) + 3 * p
        sparsity[2 * i : 2 * i + 2, at : at + 3] = 1
        if c:
            sparsity[2 * i : 2 * i + 2, 6 * (c - 1) : 6 * c] = 1
    rotations = Rotation.from_matrix(problem.T_cam_world[1:, :3, :3]).as_rotvec()
    x0 = np.concatenate([np.hstack([rotations, problem.T_cam_world[1:, :3, 3]]).ravel(), problem.points_world.ravel()])
    return 2 * least_squares(residuals, x0, jac_sparsity=sparsity, x_scale="jac", ftol=1e-8, max_nfev=60).cost


@pytest.mark.parametrize(("num_fixed", "damping"), [(2, 0.0), (1, 0.1)])
def test_one_schur_step_equals_the_dense_solve(num_fixed, damping):
    problem = small(num_fixed)
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    H += damping * np.diag(np.diag(H))
    free = np.flatnonzero(problem.camera_is_free)
    used = np.diag(H) > 0  # not the point that is seen once
    assert (~used).sum() == 3
    step = np.zeros(len(g))
    step[used] = -np.linalg.solve(H[np.ix_(used, used)], g[used])
    system = ReducedSystem(sightings_of(problem), free_slots(problem), SIGMA)
    moved = system.step(Variables.of(problem, pinhole_model(PINHOLE)), damping).moved
    R, t, points = moved.R, moved.t, moved.points
    scale = np.abs(step).max()
    np.testing.assert_allclose(points - problem.points_world, step[6 * len(free) :].reshape(-1, 3), atol=1e-8 * scale)
    for n, c in enumerate(free):
        expected = reference.exp_se3(step[6 * n : 6 * n + 6]) @ problem.T_cam_world[c]
        np.testing.assert_allclose(R[c], expected[:3, :3], atol=1e-8 * scale)
        np.testing.assert_allclose(t[c], expected[:3, 3], atol=1e-8 * scale)
    assert scale > 1e-3


def test_one_subspace_sweep_equals_dense_blocks():
    """Eq. 11 for the cameras, each by its own 6×6 block, and then Eq. 12 at the moved cameras."""
    problem = small(1)
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    poses = problem.T_cam_world.copy()
    for n, c in enumerate(np.flatnonzero(problem.camera_is_free)):
        block = slice(6 * n, 6 * n + 6)
        poses[c] = reference.exp_se3(-np.linalg.solve(H[block, block], g[block])) @ poses[c]
    moved = dataclasses.replace(problem, T_cam_world=poses)
    H, g = reference.full_normal_equations(moved, PINHOLE.intrinsics, SIGMA)
    points = problem.points_world.copy()
    for p in range(1, len(points)):
        block = slice(12 + 3 * p, 15 + 3 * p)
        points[p] -= np.linalg.solve(H[block, block], g[block])
    moved = dataclasses.replace(moved, points_world=points)
    solved, report = adjust_subspace(problem, PINHOLE, SIGMA, 1)
    assert reference.robust_cost(moved, PINHOLE.intrinsics, SIGMA) == pytest.approx(report.costs[1], rel=1e-6)
    np.testing.assert_allclose(solved.T_cam_world, poses, atol=1e-7)
    np.testing.assert_allclose(solved.points_world, points, atol=1e-6)


@pytest.mark.parametrize("sweeps", [1, 3, 3000])
def test_inner_sweeps_solve_the_full_equations_block_by_block(sweeps, monkeypatch):
    """Cameras by their 6×6 blocks, then points by their 3×3 ones, with the derivatives of the start; in the end H dx = -g."""
    problem = small(2)
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    used = np.diag(H) > 0  # not the point that is seen once
    x, blocks = np.zeros(len(g)), [slice(k, k + 6) for k in range(0, 6, 6)] + [slice(k, k + 3) for k in range(6, len(g), 3)]
    for _ in range(min(sweeps, 3)):
        for block in (b for b in blocks if used[b].all()):
            x[block] -= np.linalg.solve(H[block, block], g[block] + H[block] @ x)
    if sweeps > 3:
        x[used] = -np.linalg.solve(H[np.ix_(used, used)], g[used])
    monkeypatch.setattr(subspace, "INNER_SWEEPS", sweeps)
    solved, _ = SOLVERS["subspace-inner"](problem, PINHOLE, SIGMA, 1, 0.0)
    size = np.abs(x).max()
    np.testing.assert_allclose(solved.points_world - problem.points_world, x[6:].reshape(-1, 3), atol=1e-5 * size)
    np.testing.assert_allclose(solved.T_cam_world[2], reference.exp_se3(x[:6]) @ problem.T_cam_world[2], atol=1e-5 * size)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_fixed_cameras_and_points_seen_once_stay(name):
    problem = small(2)
    solved, _ = SOLVERS[name](problem, PINHOLE, SIGMA, 5, 1e-5)
    np.testing.assert_array_equal(solved.T_cam_world[:2], problem.T_cam_world[:2])
    np.testing.assert_array_equal(solved.points_world[0], problem.points_world[0])
    assert (solved.T_cam_world[2] != problem.T_cam_world[2]).any()
    assert (solved.points_world[1:] != problem.points_world[1:]).any(axis=1).all()


@pytest.mark.parametrize("name", list(SOLVERS))
def test_nothing_free_moves_points_alone(name):
    problem = small(3)
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
    problem = small(1)
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


def test_a_sweep_allocates_nothing(start):
    """Counted by numba's own runtime, which also counts one for each array that Python hands over."""
    runtime = pytest.importorskip("numba.core.runtime")
    runtime._nrt_python.memsys_enable_stats()
    variables, scratch = Variables.of(start, pinhole_model(PINHOLE)), new_scratch()
    views, sightings = variables.views(free_slots(start)), sightings_of(start)
    before = runtime.rtsys.get_allocation_stats().alloc
    sweep_cameras(views, sightings, variables.points, 0.25, scratch)
    sweep_points(views, sightings, variables.points, 0.25)
    handed_over = 2 * sum(isinstance(a, np.ndarray) for a in (*views, *sightings, variables.points)) + len(scratch)
    assert runtime.rtsys.get_allocation_stats().alloc - before in (0, handed_over)


@pytest.mark.parametrize("own", [False, True])
def test_one_step_with_camera_parameters_equals_the_dense_solve(own):
    """The full matrix by finite differences of all residuals; shared parameters as a border, own ones in the cameras' blocks."""
    rng = np.random.default_rng(4)
    scene = arc_scene(4, 20, rng)
    scene = dataclasses.replace(scene, pixels=scene.pixels + rng.normal(0, 0.5, scene.pixels.shape))
    poses, points = perturbed(scene, rng, 0.005, 0.02)
    problem = problem_of(scene, 2, poses, points)
    models = np.repeat(PINHOLE.with_model([520, 510, 321.5, 239, -0.1, 0.02, 0, 0]).model[None], 4 if own else 1, axis=0)
    basis, free, damping = np.zeros((8, 2)), (2, 3), 0.01
    basis[:2, 0], basis[4, 1] = (1.0, 510 / 520), 1.0
    num_models = len(free) if own else 1

    def moved(x):
        T, m = problem.T_cam_world.copy(), models.copy()
        for n, c in enumerate(free):
            T[c] = reference.exp_se3(x[6 * n : 6 * n + 6]) @ T[c]
        for n, c in enumerate(free if own else (0,)):
            m[c] += basis @ x[12 + 2 * n : 14 + 2 * n]
        return T, m, problem.points_world + x[12 + 2 * num_models :].reshape(-1, 3)

    def residuals(x):
        T, m, X = moved(x)
        rows = []
        for c, p, u in zip(problem.obs_camera, problem.obs_point, problem.obs_pixels, strict=True):
            camera = PINHOLE.with_model(m[c if own else 0])
            rows.append((camera.distort(camera.ideal_from_points((T[c] @ np.append(X[p], 1))[None, :3])) - u)[0])
        return np.array(rows)

    size = 12 + 2 * num_models + 60
    J = np.stack([(residuals(1e-6 * d) - residuals(-1e-6 * d)) / 2e-6 for d in np.eye(size)], axis=-1)
    r = residuals(np.zeros(size))
    w = reference.geman_mcclure_weight(np.linalg.norm(r, axis=1), SIGMA)
    H, g = np.einsum("mia,m,mib->ab", J, w, J), np.einsum("mia,m,mi->a", J, w, r)
    expected = moved(-np.linalg.solve(H + damping * np.diag(np.diag(H)), g))
    system = ReducedSystem(sightings_of(problem), free_slots(problem), SIGMA, basis, own)
    step = system.step(Variables.of(problem, models), damping).moved
    np.testing.assert_allclose(step.R, expected[0][:, :3, :3], atol=1e-7)
    np.testing.assert_allclose(step.t, expected[0][:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(step.models, expected[1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(step.points, expected[2], atol=1e-5)
    assert np.abs(step.models - models).max() > 0.1


def test_the_kernels_bending_is_bounded_and_only_along_the_residual(rng):
    problem = small(1)
    variables = Variables.of(problem, pinhole_model(PINHOLE))
    traces = []
    for bend in (0.0, 0.5):
        system = ReducedSystem(sightings_of(problem), free_slots(problem), SIGMA)
        system.build(variables, 0.0, bend)
        traces.append(np.trace(system.equations.H_cameras[0]))
    assert 0.5 * traces[0] < traces[1] < traces[0]
