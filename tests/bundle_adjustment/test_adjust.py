# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, orbit, perturbed, problem_of, with_noise
from scipy.spatial.transform import Rotation

from vitamin3d.bundle_adjustment.adjust import SOLVERS, AdjustmentSettings, adjust
from vitamin3d.bundle_adjustment.problem import make_problem
from vitamin3d.bundle_adjustment.variables import Variables, pinhole_model, squared_errors_of
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import PinholeCamera

MODEL = pinhole_model(PINHOLE)
SIGMA = 2.0


@pytest.fixture(scope="module")
def start():
    scene, _ = with_noise(arc_scene(6, 120, np.random.default_rng(1)), np.random.default_rng(2))
    poses, points = perturbed(scene, np.random.default_rng(3), 0.01, 0.03)
    return problem_of(scene, poses=poses, points=points)


def settings(name, **more):
    more = {"iterations": 300 if name == "subspace" else 40, "relative_gain": 1e-7, **more}
    return AdjustmentSettings(solver=name, sigma_px=SIGMA, **more)


def test_arrays_in_any_order_make_the_same_problem(start, rng):
    rows = rng.permutation(len(start.obs_pixels))
    made = make_problem(start.T_cam_world, start.points_world, start.obs_camera[rows], start.obs_point[rows], start.obs_pixels[rows])
    np.testing.assert_array_equal(made.obs_camera, start.obs_camera)
    np.testing.assert_array_equal(rows[made.obs_rows[made.point_order]], start.point_order)
    np.testing.assert_array_equal(made.camera_is_free, start.camera_is_free)
    assert (np.diff(made.obs_camera[made.point_order].reshape(-1)[: made.point_starts[1]]) > 0).all()


@pytest.mark.parametrize("name", list(SOLVERS))
def test_all_solvers_find_the_same_minimum(name, start):
    best = adjust(start, MODEL, settings("schur", iterations=200, relative_gain=1e-12)).report.costs[-1]
    adjusted = adjust(start, MODEL, settings(name))
    assert adjusted.rejection.summary() == "" and adjusted.report.stopped == "gain"
    assert adjusted.report.costs[-1] == pytest.approx(best, rel=2e-2 if name == "subspace" else 1e-3)
    assert (np.diff(adjusted.report.costs) <= 0).all()
    assert reference.robust_cost(adjusted.problem, PINHOLE.intrinsics, SIGMA) == pytest.approx(adjusted.report.costs[-1], rel=1e-9)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_the_report_tells_how_it_went(name, start):
    report = adjust(start, MODEL, settings(name)).report
    assert len(report.gradient_norms) == len(report.pose_steps) == len(report.point_steps) == len(report.costs) - 1
    assert report.gradient_norms[-1] < 0.1 * report.gradient_norms[0]
    assert 0 < report.pose_steps[-1] < 0.1 * report.pose_steps[0] and report.point_steps[0] > 0
    short = adjust(start, MODEL, settings(name, iterations=1)).report
    assert short.stopped == "iterations" and not short.converged and len(short.costs) == 2


@pytest.mark.parametrize("name", list(SOLVERS))
def test_the_solution_turns_with_the_world(name, start):
    """Of a similarity of the world the solvers see nothing: the solution is the same, moved."""
    s, R, t = 3.7, Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([5.0, -2.0, 1.0])
    poses = start.T_cam_world.copy()
    poses[:, :3, :3] = start.T_cam_world[:, :3, :3] @ R.T
    poses[:, :3, 3] = s * start.T_cam_world[:, :3, 3] - poses[:, :3, :3] @ t
    moved = dataclasses.replace(start, T_cam_world=poses, points_world=s * start.points_world @ R.T + t)
    steps = settings(name, iterations=4 if name == "subspace" else 60, relative_gain=1e-13)
    here, there = (adjust(dataclasses.replace(p, camera_is_free=two_fixed()), MODEL, steps) for p in (start, moved))
    assert there.report.costs[-1] == pytest.approx(here.report.costs[-1], rel=1e-6)
    np.testing.assert_allclose(there.problem.points_world, s * here.problem.points_world @ R.T + t, atol=2e-3)


def two_fixed():
    """Cameras that hold the scale as well."""
    return np.array([False, True, True, True, True, False])


def test_a_scale_that_narrows_finds_what_a_narrow_one_misses():
    rng = np.random.default_rng(7)
    scene, _ = with_noise(orbit(PINHOLE, 150, rng), rng, 0.3, 0.2)
    poses, points = perturbed(scene, rng, 0.1, 1.0)
    best = adjust(problem_of(scene), MODEL, AdjustmentSettings(sigma_px=1.0)).report.costs[-1]
    far = problem_of(scene, poses=poses, points=points)
    narrow = adjust(far, MODEL, AdjustmentSettings(sigma_px=1.0)).report.costs[-1]
    staged = adjust(far, MODEL, AdjustmentSettings(sigma_px=1.0, first_sigma_px=64.0)).report.costs[-1]
    assert staged == pytest.approx(best, rel=1e-5) and narrow > 1.5 * best


@pytest.mark.parametrize("gauge", ["first", "free"])
def test_gauges_agree_on_the_cost(gauge, start):
    loose = dataclasses.replace(start, camera_is_free=np.zeros(6, bool))
    adjusted = adjust(loose, MODEL, settings("schur", gauge=gauge))
    given = adjust(start, MODEL, settings("schur"))
    assert adjusted.report.costs[-1] == pytest.approx(given.report.costs[-1], rel=1e-4)
    moved = (adjusted.problem.T_cam_world[0] != start.T_cam_world[0]).any()
    assert moved == (gauge == "free")


@pytest.mark.parametrize("own", [False, True])
def test_camera_parameters_shared_or_each_its_own(own):
    rng = np.random.default_rng(4)
    scene = orbit(PINHOLE, 150, rng)
    scene = dataclasses.replace(scene, pixels=scene.pixels + 0.1 * rng.standard_normal(scene.pixels.shape))
    wrong = MODEL * [1.02, 1.02, 1, 1, 1, 1, 1, 1]
    models = np.repeat(wrong, 12, axis=0) if own else wrong
    problem = problem_of(scene, 1)
    chosen = settings("subspace-accelerated", free=("f",), own=own, iterations=100, relative_gain=1e-9)
    adjusted = adjust(problem, models, chosen)
    held = adjust(problem, models, settings("schur"))
    assert adjusted.models.shape == models.shape
    assert adjusted.report.costs[-1] < 0.98 * held.report.costs[-1]
    free = adjusted.models[1:] if own else adjusted.models
    np.testing.assert_allclose(free[:, 0], PINHOLE.fx, rtol=0.015)
    np.testing.assert_allclose(free[:, 1] / free[:, 0], PINHOLE.fy / PINHOLE.fx, rtol=1e-9)
    if own:
        np.testing.assert_array_equal(adjusted.models[0], models[0])
        assert len(np.unique(adjusted.models[:, 0])) == 12


def spoilt(start):
    """One of each kind: a NaN pixel and point, a doubled observation, a point behind, one seen once, one far away, one camera unseen."""
    pixels, points = start.obs_pixels.copy(), start.points_world.copy()
    points[5] = np.nan
    points[7] = [0.1, 0.2, -30.0]
    points[9] = [0.0, 0.0, 1e12]
    row = int(np.flatnonzero(start.obs_point == 11)[0])
    pixels[row, 1] = np.nan
    only_once = start.obs_point != 13
    only_once[np.flatnonzero(~only_once)[0]] = True
    camera, point = np.append(start.obs_camera[only_once], 2), np.append(start.obs_point[only_once], 20)
    pixels = np.vstack([pixels[only_once], start.obs_pixels[(start.obs_camera == 2) & (start.obs_point == 20)] + 5.0])
    poses = np.concatenate([start.T_cam_world, np.eye(4)[None]])
    return make_problem(poses, points, camera, point, pixels)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_what_is_degenerate_is_left_out_by_name(name, start):
    problem = spoilt(start)
    adjusted = adjust(problem, MODEL, settings(name))
    rejected = adjusted.rejection
    assert (problem.obs_point[rejected.not_finite] == 5).sum() == (problem.obs_point == 5).sum()
    assert (problem.obs_point[rejected.not_finite] == 11).sum() == 1
    assert problem.obs_point[rejected.duplicate].tolist() == [20]
    assert set(problem.obs_point[rejected.behind].tolist()) == {7}
    assert rejected.at_infinity.tolist() == [9] and rejected.unobserved_cameras.tolist() == [6]
    assert set(rejected.seen_once.tolist()) >= {7, 13} and 20 not in rejected.seen_once
    assert "1 duplicate" in rejected.summary() and "1 unobserved cameras" in rejected.summary()
    for point in (5, 7, 9, 13):
        np.testing.assert_array_equal(adjusted.problem.points_world[point], problem.points_world[point])
    np.testing.assert_array_equal(adjusted.problem.T_cam_world[6], np.eye(4))
    kept = np.delete(np.arange(120), [5, 7, 9, 13])
    assert np.isfinite(adjusted.problem.points_world[kept]).all() and np.isfinite(adjusted.problem.T_cam_world).all()
    assert np.isfinite(adjusted.report.costs).all()
    clean = adjust(start, MODEL, settings(name))
    other = np.delete(kept, np.searchsorted(kept, [11, 20]))
    np.testing.assert_allclose(adjusted.problem.points_world[other], clean.problem.points_world[other], atol=0.15)


def test_a_camera_that_is_not_finite_is_left_out(start):
    poses = start.T_cam_world.copy()
    poses[3] = np.nan
    adjusted = adjust(dataclasses.replace(start, T_cam_world=poses), MODEL, settings("schur"))
    assert np.isnan(adjusted.problem.T_cam_world[3]).all()
    assert np.isfinite(np.delete(adjusted.problem.T_cam_world, 3, axis=0)).all() and np.isfinite(adjusted.problem.points_world).all()
    assert len(adjusted.rejection.not_finite) == (start.obs_camera == 3).sum()


def test_plain_least_squares_is_an_infinite_scale(start):
    adjusted = adjust(start, MODEL, AdjustmentSettings(sigma_px=np.inf))
    assert adjusted.report.costs[-1] == pytest.approx(
        squared_errors_of(adjusted.problem, Variables.of(adjusted.problem, MODEL)).sum(), rel=1e-9
    )
    assert adjusted.report.costs[-1] < adjusted.report.costs[0]


@pytest.mark.parametrize(
    "bad",
    [
        {"solver": "ceres"}, {"gauge": "last"}, {"solver": "subspace", "free": ("f",)},
        {"solver": "subspace-inner", "free": ("f",)}, {"free": ("f",), "own": True},
        {"sigma_px": 0.0}, {"free": ("focal",)},
    ],
)  # fmt: skip
def test_settings_are_checked(bad, start):
    with pytest.raises(InputError):
        adjust(start, MODEL, AdjustmentSettings(**bad))


def test_a_problem_without_observations_is_returned_as_it_is():
    none = np.zeros(0, np.int32)
    empty = make_problem(np.tile(np.eye(4), (2, 1, 1)), np.ones((3, 3)), none, none, np.zeros((0, 2)))
    for name in SOLVERS:
        adjusted = adjust(empty, MODEL, settings(name))
        np.testing.assert_array_equal(adjusted.problem.points_world, empty.points_world)
        assert adjusted.rejection.unobserved_cameras.tolist() == [1] and adjusted.report.num_observations == 0


def test_the_camera_class_is_one_way_to_a_model():
    lens = PinholeCamera(400.0, 410.0, 320.0, 240.0, 640, 480, (-0.2, 0.05, 1e-3, 2e-3))
    assert lens.with_model(lens.model) == lens
