# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import PINHOLE, project
from scipy.optimize import least_squares

from vitamin3d.bundle_adjustment.variables import pinhole_model
from vitamin3d.config import LocalizationConfig
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.localization import p3p_localization as loc

CONFIG = LocalizationConfig()
TRUTH = exp_se3(np.array([-0.5, 0.1, 0.3, 0.05, 0.2, -0.1]))


def view(rng, count=300, outlier_share=0.0, sigma_px=0.0):
    """Points, their pixels, and which are (N,) outliers."""
    in_camera = rng.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (count, 3)) * rng.uniform(3, 9, (count, 1))
    points = (in_camera - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    pixels = project(PINHOLE, TRUTH, points) + sigma_px * rng.standard_normal((count, 2))
    is_outlier = np.arange(count) < outlier_share * count
    pixels[is_outlier] = rng.uniform(0, [640, 480], (is_outlier.sum(), 2))
    return points, pixels, is_outlier


def parts(T):
    """What the kernels take: the camera's model, R (1, 3, 3), t (1, 3)."""
    return pinhole_model(PINHOLE), np.ascontiguousarray(T[None, :3, :3]), np.ascontiguousarray(T[None, :3, 3])


def test_normal_equations_and_cost_equal_their_twins(rng):
    points, pixels, _ = view(rng, 40, 0.2, 1.0)
    points[0] = np.linalg.inv(TRUTH)[:3] @ [0, 0, -2, 1]  # behind
    H, g, cost, expected_H, expected_g = np.zeros((6, 6)), np.empty(6), 0.0, np.zeros((6, 6)), np.zeros(6)
    for X, u in zip(points, pixels, strict=True):
        r = reference.residual(PINHOLE.intrinsics, TRUTH, X, u)
        if r is None:
            cost += 9.0
            continue
        J, _ = reference.jacobians(PINHOLE.intrinsics, TRUTH, X)
        w = reference.geman_mcclure_weight(np.linalg.norm(r), 3.0)
        expected_H, expected_g = expected_H + w * J.T @ J, expected_g + w * J.T @ r
        cost += reference.geman_mcclure(np.linalg.norm(r), 3.0)
    loc._normal_equations(*parts(TRUTH), points, pixels, 1.0 / 9.0, np.empty(27), H, g)
    np.testing.assert_allclose(np.triu(H), np.triu(expected_H), rtol=1e-9, atol=1e-9 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, rtol=1e-8, atol=1e-9 * np.abs(expected_g).max())
    assert loc._cost(*parts(TRUTH), points, pixels, 1.0 / 9.0) == pytest.approx(cost, rel=1e-10)


def test_refinement_reaches_the_minimum_that_scipy_finds(rng):
    points, pixels, _ = view(rng, 100, 0.1, 1.0)
    start = exp_se3(np.full(6, 0.004)) @ TRUTH

    def residuals(xi):
        r = project(PINHOLE, reference.exp_se3(xi) @ start, points) - pixels
        return (r * 2.0 / np.sqrt((r**2).sum(axis=1, keepdims=True) + 4.0)).ravel()

    best = least_squares(residuals, np.zeros(6), x_scale="jac", ftol=1e-12, xtol=1e-12)
    refined = loc.refine_pose(start, points, pixels, PINHOLE, 2.0, 30)
    assert loc._cost(*parts(refined), points, pixels, 0.25) == pytest.approx(2 * best.cost, rel=1e-5)
    np.testing.assert_allclose(refined, reference.exp_se3(best.x) @ start, atol=2e-4)
    np.testing.assert_allclose(refined[:3, :3] @ refined[:3, :3].T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("iterations", [1, 2, 3, 5, 8])
def test_refinement_never_raises_the_cost(rng, iterations):
    points, pixels, _ = view(rng, 60, 0.3, 1.0)
    start = exp_se3(np.full(6, 0.05)) @ TRUTH
    costs = [
        loc._cost(*parts(loc.refine_pose(start, points, pixels, PINHOLE, 2.0, n)), points, pixels, 0.25)
        for n in (0, iterations - 1, iterations)
    ]
    assert costs[0] >= costs[1] - 1e-9 >= costs[2] - 2e-9


@pytest.mark.parametrize("prior", [None, TRUTH, exp_se3(np.full(6, 0.02)) @ TRUTH, np.eye(4)], ids=["none", "exact", "near", "far"])
def test_the_pose_is_found_among_forty_percent_outliers(rng, prior):
    points, pixels, is_outlier = view(rng, 300, 0.4)
    found = loc.localize(points, pixels, prior, PINHOLE, CONFIG, seed=1)
    assert found.converged
    np.testing.assert_allclose(found.T_cam_world, TRUTH, atol=1e-3)
    np.testing.assert_array_equal(found.is_inlier[~is_outlier], True)
    assert found.is_inlier[is_outlier].mean() < 0.05
    assert found.rmse_px < 0.7


def test_noise_shows_in_the_error(rng):
    points, pixels, _ = view(rng, 400, 0.2, 0.5)
    found = loc.localize(points, pixels, None, PINHOLE, CONFIG)
    assert found.converged and 0.55 < found.rmse_px < 0.95  # 0.5 px in each coordinate: 0.71
    np.testing.assert_allclose(found.T_cam_world, TRUTH, atol=5e-3)


def test_the_same_seed_gives_the_same_pose(rng):
    points, pixels, _ = view(rng, 1000, 0.4, 0.5)
    a, b = (loc.localize(points, pixels, None, PINHOLE, CONFIG, seed=3).T_cam_world for _ in range(2))
    assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("count", [0, 3, 29])
def test_too_few_landmarks_do_not_converge(rng, count):
    points, pixels, _ = view(rng, count)
    found = loc.localize(points, pixels, TRUTH, PINHOLE, CONFIG)
    assert not found.converged and found.is_inlier.shape == (count,) and not found.is_inlier.any()
    np.testing.assert_array_equal(found.T_cam_world, TRUTH)


@pytest.mark.parametrize(("min_ratio", "converges"), [(0.25, False), (0.1, True)])
def test_a_small_share_of_inliers_does_not_converge(rng, min_ratio, converges):
    points, pixels, is_outlier = view(rng, 300, 0.85)
    found = loc.localize(points, pixels, TRUTH, PINHOLE, LocalizationConfig(min_inlier_ratio=min_ratio))
    assert found.converged == converges and found.is_inlier[~is_outlier].sum() == 45


def numbers(*counts):
    """So many landmarks with so many observations each."""
    return np.concatenate([np.full(count, observations, np.int32) for count, observations in counts])


@pytest.mark.parametrize(
    ("num_observations", "fewest"),
    [
        (numbers((60, 8), (500, 7)), 8),
        (numbers((59, 9), (1, 7), (500, 3)), 4),
        (numbers((20, 9), (39, 5), (1, 3), (9, 1)), 2),
        (numbers((10, 3), (9, 1)), 2),
        (numbers((0, 1)), 2),
    ],
)
def test_landmarks_with_many_observations_vote_and_where_they_are_few_those_with_half_as_many(num_observations, fewest):
    np.testing.assert_array_equal(loc.voters(num_observations, CONFIG), num_observations >= fewest)


def test_without_votes_all_landmarks_localise():
    assert loc.voters(numbers((5, 1), (5, 9)), LocalizationConfig(votes=0)).all()


def test_voters_alone_decide_and_judge_the_others(rng):
    points, pixels, _ = view(rng, 400, 0.0, 0.4)
    elsewhere = exp_se3(np.array([0.3, -0.2, 0.1, 0.01, 0.05, 0.02])) @ TRUTH
    pixels[100:340] = project(PINHOLE, elsewhere, points[100:340])  # a majority agrees on another pose
    is_voter = np.arange(400) < 100
    found = loc.localize_by(is_voter, points, pixels, None, PINHOLE, CONFIG, seed=2)
    alone = loc.localize(points[:100], pixels[:100], None, PINHOLE, CONFIG, seed=2)
    assert found.converged and found.T_cam_world.tobytes() == alone.T_cam_world.tobytes() and found.rmse_px == alone.rmse_px
    np.testing.assert_allclose(found.T_cam_world, TRUTH, atol=5e-3)
    np.testing.assert_array_equal(found.is_inlier[:100], alone.is_inlier)
    assert found.is_inlier[100:340].mean() < 0.1 and found.is_inlier[340:].mean() > 0.9
    whole = loc.localize(points, pixels, None, PINHOLE, CONFIG, seed=2)
    assert whole.is_inlier[100:340].mean() > 0.9


def test_voters_that_disagree_find_nothing_whatever_the_others_say(rng):
    points, pixels, _ = view(rng, 400, 0.25)
    is_voter = np.arange(400) < 100  # the outliers
    found = loc.localize_by(is_voter, points, pixels, TRUTH, PINHOLE, CONFIG)
    assert not found.converged and found.is_inlier.shape == (400,) and not found.is_inlier.any()
    none = loc.localize_by(np.zeros(400, np.bool_), points, pixels, TRUTH, PINHOLE, CONFIG)
    assert not none.converged and not none.is_inlier.any()
    np.testing.assert_array_equal(none.T_cam_world, TRUTH)


def test_where_all_vote_it_is_the_usual_localisation(rng):
    points, pixels, _ = view(rng, 200, 0.3, 0.5)
    a, b = (f(points, pixels, None, PINHOLE, CONFIG, 7) for f in (loc.localize, lambda *x: loc.localize_by(np.ones(200, np.bool_), *x)))
    assert a.T_cam_world.tobytes() == b.T_cam_world.tobytes() and (a.is_inlier == b.is_inlier).all() and a.rmse_px == b.rmse_px


@pytest.mark.parametrize("prior", [None, TRUTH])
def test_garbage_does_not_converge(rng, prior):
    points, pixels = rng.uniform(-5, 5, (200, 3)), rng.uniform(0, 480, (200, 2))
    assert not loc.localize(points, pixels, prior, PINHOLE, CONFIG).converged
    assert not loc.localize(np.zeros((200, 3)), pixels, prior, PINHOLE, CONFIG).converged
    behind = np.linalg.inv(TRUTH)[:3] @ np.vstack([rng.uniform(-1, 1, (2, 200)), np.full(200, -4.0), np.ones(200)])
    assert not loc.localize(behind.T, rng.uniform(0, 480, (200, 2)), prior, PINHOLE, CONFIG).converged


def test_nan_pixels_do_not_converge_and_do_not_raise(rng):
    points, pixels, _ = view(rng, 100)
    for prior in (TRUTH, None):
        assert not loc.localize(points, np.full_like(pixels, np.nan), prior, PINHOLE, CONFIG).converged
