# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import texture, warped
from scipy.optimize import minimize

from vitamin3d.config import DominantFlowConfig
from vitamin3d.tracking.dominant_flow import CoarseFeatures, coarse_features, estimate_dominant_flow, fit_affine_flow, match_features
from vitamin3d.types import DominantFlow

A = np.array([[1.02, -0.03], [0.025, 0.99]])
B = np.array([-9.0, 14.0])
IDENTITY = DominantFlow(np.eye(2), np.zeros(2), 0.7)
CONFIG = DominantFlowConfig()
CORNERS = np.array([[0, 0], [639, 0], [0, 479], [639, 479], [320, 240]], float)


def picture(seed=4):
    return texture(480, 640, np.random.default_rng(seed), 7.0)


def error_px(A_found, b_found):
    """Largest distance between the flows over the picture."""
    return np.linalg.norm(CORNERS @ A_found.T + b_found - CORNERS @ A.T - B, axis=1).max()


def test_a_known_warp_of_a_picture_is_recovered():
    image = picture()
    flow = estimate_dominant_flow(coarse_features(image, CONFIG), coarse_features(warped(image, A, B), CONFIG), IDENTITY, CONFIG)
    assert error_px(flow.A, flow.b) < 3.0  # half a pixel of the reduced picture
    assert flow.inlier_ratio > 0.5


def test_the_same_picture_does_not_move():
    features = coarse_features(picture(), CONFIG)
    flow = estimate_dominant_flow(features, features, IDENTITY, CONFIG)
    np.testing.assert_allclose(flow.A, np.eye(2), atol=1e-8)
    np.testing.assert_allclose(flow.b, 0.0, atol=1e-5)
    assert flow.inlier_ratio == 1.0


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_fit_ignores_outliers(rng, share):
    x = rng.uniform(0, [640, 480], (200, 2))
    y = x @ A.T + B + 0.3 * rng.standard_normal((200, 2))
    bad = np.arange(200) < 200 * share
    y[bad] = rng.uniform(0, [640, 480], (bad.sum(), 2))
    A_found, b_found, residuals = fit_affine_flow(x, y, 6.0, 20)
    assert error_px(A_found, b_found) < 0.5
    np.testing.assert_allclose(residuals, np.linalg.norm(y - x @ A_found.T - b_found, axis=1), atol=1e-9)
    assert residuals[~bad].max() < 2.0 and (share == 0.0 or np.median(residuals[bad]) > 50)


def test_fit_minimises_equation_2(rng):
    x = rng.uniform(0, [640, 480], (60, 2))
    y = x @ A.T + B + 2.0 * rng.standard_normal((60, 2))
    y[:15] += rng.uniform(-80, 80, (15, 2))
    sigma = 4.0

    def objective(theta):
        squared = ((y - x @ theta[:4].reshape(2, 2).T - theta[4:]) ** 2).sum(axis=1)
        return (squared / (squared + sigma**2)).sum()

    A_found, b_found, _ = fit_affine_flow(x, y, sigma, 100)
    found = np.concatenate([A_found.ravel(), b_found])
    best = minimize(objective, found, method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-10, "fatol": 1e-12})
    assert objective(found) - best.fun < 1e-5 * best.fun
    assert best.fun > 1.0


def test_a_degenerate_fit_stays_finite():
    line = np.column_stack([np.arange(20.0), np.zeros(20)])
    for x, y in ((line, line + 3), (np.ones((5, 2)), np.ones((5, 2)))):
        A_found, b_found, residuals = fit_affine_flow(x, y, 6.0, 20)
        assert np.isfinite(A_found).all() and np.isfinite(b_found).all()
        np.testing.assert_allclose(residuals, 0.0, atol=1e-6)


@pytest.mark.parametrize("black_first", [True, False])
def test_a_black_picture_gives_the_fallback(black_first):
    black, image = coarse_features(np.zeros((480, 640), np.uint8), CONFIG), coarse_features(picture(), CONFIG)
    fallback = DominantFlow(A, B, 0.9)
    flow = estimate_dominant_flow(*((black, image) if black_first else (image, black)), fallback, CONFIG)
    np.testing.assert_array_equal(flow.A, A)
    np.testing.assert_array_equal(flow.b, B)
    assert flow.inlier_ratio == 0.0
    assert len(black.pixels) == 0 and black.descriptors.shape == (0, 32)


def test_without_a_previous_picture_the_fallback_is_given():
    flow = estimate_dominant_flow(None, coarse_features(picture(), CONFIG), IDENTITY, CONFIG)
    assert flow.inlier_ratio == 0.0 and np.array_equal(flow.A, np.eye(2))


def test_pictures_that_share_nothing_give_the_fallback():
    fallback = DominantFlow(A, B, 0.9)
    flow = estimate_dominant_flow(coarse_features(picture(1), CONFIG), coarse_features(picture(2), CONFIG), fallback, CONFIG)
    assert flow.inlier_ratio == 0.0
    np.testing.assert_array_equal(flow.A, A)


def test_matches_are_mutual_and_paired():
    pixels = np.arange(8.0).reshape(4, 2)
    descriptors = np.array([[0] * 32, [255] * 32, [15] * 32, [240] * 32], np.uint8)
    x, y = match_features(CoarseFeatures(pixels, descriptors), CoarseFeatures(10 + pixels[::-1], descriptors[::-1]))
    np.testing.assert_array_equal(y, x + 10)
    assert len(x) == 4
    x, y = match_features(CoarseFeatures(pixels[:1], descriptors[:1]), CoarseFeatures(pixels, descriptors))
    np.testing.assert_array_equal(x, y)
    assert len(x) == 1


@pytest.mark.parametrize("shape", [(3, 4), (47, 33), (481, 643)])
def test_features_of_odd_sizes_lie_in_the_picture(shape):
    features = coarse_features(texture(*shape, np.random.default_rng(0), 5.0), CONFIG)
    assert len(features.pixels) == len(features.descriptors) <= CONFIG.max_features + 1
    assert ((features.pixels > -0.5) & (features.pixels < [shape[1] - 0.5, shape[0] - 0.5])).all()
    assert len(features.pixels) > 20 or shape != (481, 643)
