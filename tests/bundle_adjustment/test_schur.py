# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, perturbed, problem_of, three_cameras
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from vitamin3d.bundle_adjustment.schur import ReducedSystem, adjust_schur
from vitamin3d.bundle_adjustment.variables import (
    Variables,
    free_slots,
    pinhole_model,
    sightings_of,
)

SIGMA = 2.0


@pytest.mark.slow
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
    problem = three_cameras(num_fixed)
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
    problem = three_cameras(1)
    variables = Variables.of(problem, pinhole_model(PINHOLE))
    traces = []
    for bend in (0.0, 0.5):
        system = ReducedSystem(sightings_of(problem), free_slots(problem), SIGMA)
        system.build(variables, 0.0, bend)
        traces.append(np.trace(system.equations.H_cameras[0]))
    assert 0.5 * traces[0] < traces[1] < traces[0]
