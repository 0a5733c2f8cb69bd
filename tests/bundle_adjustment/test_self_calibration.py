# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import EUROC, PINHOLE, arc_scene, orbit, perturbed, problem_of, project

from vitamin3d._jit import kernel
from vitamin3d._simd import splat, total
from vitamin3d.bundle_adjustment.problem import points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.self_calibration import adjust_with_intrinsics, parameter_basis
from vitamin3d.errors import InputError
from vitamin3d.geometry.reprojection import fill_model_derivatives, in_camera, linearize_simd, model_of, pose_of, squared_error_simd
from vitamin3d.geometry.se3 import exp_se3

SIGMA = 2.0
LENS = EUROC.with_model([460.0, 455.0, 367.0, 248.0, -0.25, 0.06, 1e-3, -5e-4])


@kernel
def run_linearize(models, is_distorted, R, t, points, pixels):
    """Eight times the same, added up: q a b r0 r1 p00 p01 p10 p11, and |r|²."""
    x, y, z = in_camera(pose_of(R, t, 0), splat(points[0, 0]), splat(points[0, 1]), splat(points[0, 2]))
    u, v, model = splat(pixels[0, 0]), splat(pixels[0, 1]), model_of(models, 0)
    _, q, a, b, r0, r1, p00, p01, p10, p11 = linearize_simd(x, y, z, is_distorted, model, u, v)
    e = squared_error_simd(x, y, z, is_distorted, model, u, v)
    return total(q), total(a), total(b), total(r0), total(r1), total(p00), total(p01), total(p10), total(p11), total(e)


def linearized(model, T, X, pixel):
    """r (2,), J_pose (2, 6), J_point (2, 3), J_model (2, 8) as the solvers put them together."""
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    scene = model[None], bool(model[4:].any()), R[None], t[None], X[None], pixel[None]
    q, a, b, r0, r1, *p, e = np.array(run_linearize(*scene)) / 8
    p, J_model = np.array(p).reshape(2, 2), np.empty((1, 2, 8))
    assert e == pytest.approx(r0 * r0 + r1 * r1, rel=1e-12)
    fill_model_derivatives(model[None], np.array([[a, b, 1.0]]), J_model)
    J_pose = p @ [[q, 0, -q * a, -a * b, 1 + a * a, -b], [0, q, -q * b, -(1 + b * b), a * b, a]]
    return np.array([r0, r1]), J_pose, J_pose[:, :3] @ R, J_model[0]


def residual(model, T, X, pixel):
    """Through the camera's own methods."""
    camera = PINHOLE.with_model(model)
    return (camera.distort(camera.ideal_from_points((T @ np.append(X, 1))[None, :3])) - pixel)[0]


def central(function, at, size=1e-6):
    steps = size * np.eye(len(at))
    return np.column_stack([(function(at + d) - function(at - d)) / (2 * size) for d in steps])


@pytest.mark.parametrize("model", [LENS.model, PINHOLE.model])
def test_residual_and_jacobians_equal_finite_differences(model, rng):
    for _ in range(10):
        T, pixel = exp_se3(0.3 * rng.standard_normal(6)), rng.uniform(0, 400, 2)
        X = np.linalg.inv(T)[:3] @ np.append(rng.uniform([-1, -1, 1.5], [1, 1, 5]), 1)
        r, J_pose, J_point, J_model = linearized(model, T, X, pixel)
        np.testing.assert_allclose(r, residual(model, T, X, pixel), atol=1e-9)
        size = np.abs(J_pose).max()
        by_pose = central(lambda d, T=T, X=X, u=pixel: residual(model, exp_se3(d) @ T, X, u), np.zeros(6))
        np.testing.assert_allclose(J_pose, by_pose, atol=1e-6 * size)
        np.testing.assert_allclose(J_point, central(lambda x, T=T, u=pixel: residual(model, T, x, u), X), atol=1e-6 * size)
        by_model = central(lambda m, T=T, X=X, u=pixel: residual(m, T, X, u), model)
        np.testing.assert_allclose(J_model, by_model, atol=1e-6 * np.abs(J_model).max())


def test_behind_the_camera_there_is_no_residual():
    scene = LENS.model[None], True, np.eye(3)[None], np.zeros((1, 3)), np.array([[0.1, 0.2, -1.0]]), np.zeros((1, 2))
    q, *_, e = run_linearize(*scene)
    assert q == 0.0 and np.isinf(e)


def seen_through(true, wrong, rng, noise_px=0.3, num_points=250, outlier_share=0.02):
    """An orbit as `true` sees it, its ideal pixels computed with the `wrong` calibration; start near the truth."""
    scene = orbit(true, num_points, rng)
    measured = true.distort(scene.pixels) + noise_px * rng.standard_normal(scene.pixels.shape)
    is_outlier = rng.random(len(measured)) < outlier_share
    measured[is_outlier] += rng.uniform(15, 40, (is_outlier.sum(), 2))
    seen = dataclasses.replace(scene, pixels=wrong.undistort(measured))
    poses, points = perturbed(seen, rng, 0.005, 0.02)
    return problem_of(seen, poses=poses, points=points), measured


@pytest.mark.parametrize(
    ("true", "free", "factors"),
    [
        (PINHOLE, ("f",), {0: 1.03, 1: 1.03}),
        (PINHOLE, ("fx", "fy", "cx", "cy"), {0: 0.97, 1: 1.03}),
        (LENS, ("f", "k1", "k2"), {0: 1.03, 1: 1.03, 4: 0.7, 5: 0.3}),
        (LENS, ("fx", "fy", "k1", "k2", "p1", "p2"), {0: 0.97, 1: 0.97, 4: 1.2, 6: 0.0}),
    ],
)
def test_a_wrong_calibration_is_found_out(true, free, factors, rng):
    model = true.model
    for k, factor in factors.items():
        model[k] *= factor
    wrong = true.with_model(model)
    problem, measured = seen_through(true, wrong, rng)
    solved, found, report = adjust_with_intrinsics(problem, wrong, free, SIGMA)
    assert report.converged and (np.diff(report.costs) <= 0).all()
    assert report.names == free and report.noise_px == pytest.approx(0.3, rel=0.1)
    names = {"f": 0, "fx": 0, "fy": 1, "cx": 2, "cy": 3, "k1": 4, "k2": 5, "p1": 6, "p2": 7}
    for name in free:
        error = abs(found.model[names[name]] - true.model[names[name]])
        assert error < 4 * report.deviations[name], name
        assert report.deviations_px[name] < 10.0
    assert abs(found.fx - true.fx) < 0.004 * true.fx < 0.2 * abs(wrong.fx - true.fx)
    np.testing.assert_allclose(found.distort(solved.obs_pixels), measured, atol=1e-6)
    np.testing.assert_array_equal(solved.T_cam_world[0], problem.T_cam_world[0])
    assert found.model[[k for k in range(8) if k not in {names[n] for n in free} | {1}]].tolist() == [
        wrong.model[k] for k in range(8) if k not in {names[n] for n in free} | {1}
    ]


def test_f_keeps_the_ratio_of_the_focal_lengths(rng):
    wrong = PINHOLE.with_model(PINHOLE.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    problem, _ = seen_through(PINHOLE, wrong, rng)
    _, found, _ = adjust_with_intrinsics(problem, wrong, ("f",), SIGMA)
    assert found.fy / found.fx == pytest.approx(PINHOLE.fy / PINHOLE.fx, rel=1e-12)
    assert (found.cx, found.cy, found.distortion) == (wrong.cx, wrong.cy, wrong.distortion)


def test_deviations_are_honest():
    """Errors of many runs divided by their reported deviations have a spread of one."""
    errors = []
    for seed in range(24):
        problem, _ = seen_through(LENS, LENS, np.random.default_rng(seed), 0.4, 120)
        _, found, report = adjust_with_intrinsics(problem, LENS, ("f", "cx", "k1"), SIGMA)
        errors.append([(found.model[i] - LENS.model[i]) / report.deviations[n] for i, n in ((0, "f"), (2, "cx"), (4, "k1"))])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (spread > 0.7).all() and (spread < 1.35).all(), spread


def test_the_covariance_is_that_of_all_variables():
    """Against the inverse of the full matrix by finite differences, gauge held by two fixed cameras."""
    rng = np.random.default_rng(3)
    scene = arc_scene(4, 20, rng)
    scene = dataclasses.replace(scene, pixels=scene.pixels + 0.3 * rng.standard_normal(scene.pixels.shape))
    free = ("f", "k1")
    solved, found, report = adjust_with_intrinsics(problem_of(scene, 2), PINHOLE, free, 1e3, 60)
    basis = parameter_basis(free, found.fy / found.fx)

    def residuals(x):
        poses = solved.T_cam_world.copy()
        for n, c in enumerate((2, 3)):
            poses[c] = exp_se3(x[6 * n : 6 * n + 6]) @ poses[c]
        points, camera = solved.points_world + x[12:72].reshape(-1, 3), found.with_model(found.model + basis @ x[72:])
        rows = [project(camera, poses[c], points[p : p + 1])[0] for c, p in zip(solved.obs_camera, solved.obs_point, strict=True)]
        return (camera.distort(np.array(rows)) - found.distort(solved.obs_pixels)).ravel()

    J = central(residuals, np.zeros(74))
    expected = report.noise_px**2 * np.linalg.inv(J.T @ J)[72:, 72:]
    np.testing.assert_allclose(report.covariance, expected, rtol=1e-3)
    rms = np.sqrt((residuals(np.zeros(74)) ** 2).sum() / (len(J) - 74))
    assert report.noise_px == pytest.approx(rms, rel=1e-3)
    assert report.deviations["f"] == pytest.approx(np.sqrt(expected[0, 0]), rel=1e-3)


def test_forward_motion_without_rotation_says_that_it_cannot_tell(rng):
    points = rng.uniform([-3, -2, 6], [3, 2, 20], (200, 3))
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = -0.5 * np.arange(6)
    scene = arc_scene(6, 200, rng)
    pixels = np.array([project(PINHOLE, poses[c], points[p : p + 1])[0] for c, p in zip(scene.obs_camera, scene.obs_point, strict=True)])
    forward = dataclasses.replace(scene, T_cam_world=poses, points=points, pixels=pixels + 0.3 * rng.standard_normal(pixels.shape))
    _, found, report = adjust_with_intrinsics(problem_of(forward), PINHOLE, ("f",), SIGMA)
    around, _ = seen_through(PINHOLE, PINHOLE, rng)
    _, _, sure = adjust_with_intrinsics(around, PINHOLE, ("f",), SIGMA)
    assert report.deviations["f"] > 0.3 * PINHOLE.fx > 100 * sure.deviations["f"]
    assert 0.5 < found.fx / PINHOLE.fx < 2.0


def test_a_prior_holds_what_the_motion_does_not_tell(rng):
    wrong = PINHOLE.with_model(PINHOLE.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    problem, _ = seen_through(PINHOLE, wrong, rng)
    _, loose, _ = adjust_with_intrinsics(problem, wrong, ("f",), SIGMA, priors={"f": 1e4})
    _, tight, report = adjust_with_intrinsics(problem, wrong, ("f",), SIGMA, priors={"f": 1e-2})
    assert abs(loose.fx - PINHOLE.fx) < 2.5
    assert abs(tight.fx - wrong.fx) < 0.5 and report.deviations["f"] <= 0.0101


def test_nothing_free_is_an_ordinary_adjustment(rng):
    problem, _ = seen_through(LENS, LENS, rng)
    solved, found, report = adjust_with_intrinsics(problem, LENS, (), SIGMA)
    assert found == LENS and report.covariance.shape == (0, 0)
    assert report.costs[-1] < 0.5 * report.costs[0]
    assert (solved.T_cam_world[1:] != problem.T_cam_world[1:]).any(axis=(1, 2)).all()


@pytest.mark.parametrize("free", [("g",), ("f", "fx"), ("k1", "k1")])
def test_names_are_checked(free):
    with pytest.raises(InputError):
        parameter_basis(free, 1.0)


def test_the_same_twice_to_the_last_bit(rng):
    problem, _ = seen_through(LENS, LENS, rng)
    (a, camera_a, _), (b, camera_b, _) = (adjust_with_intrinsics(problem, LENS, ("f", "k1"), SIGMA, 5) for _ in range(2))
    assert camera_a == camera_b and a.points_world.tobytes() == b.points_world.tobytes()


def test_a_part_of_the_points_is_a_problem_of_its_own(scene):
    problem = problem_of(scene)
    keep = points_of_long_tracks(problem, 30)
    part = select_points(problem, keep)
    assert 30 <= keep.sum() < 80
    assert (np.bincount(part.obs_camera, minlength=len(scene.T_cam_world)) >= 30).all()
    np.testing.assert_array_equal(part.points_world, problem.points_world[keep])
    np.testing.assert_array_equal(part.landmark_ids[part.obs_point], problem.obs_point[part.obs_rows])
    np.testing.assert_array_equal(part.obs_pixels, problem.obs_pixels[part.obs_rows])
    for p in range(len(part.points_world)):
        rows = part.point_order[part.point_starts[p] : part.point_starts[p + 1]]
        assert (part.obs_point[rows] == p).all() and (np.diff(part.obs_camera[rows]) > 0).all()
