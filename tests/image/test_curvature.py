# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import texture

from vitamin3d.config import CurvatureConfig
from vitamin3d.image.curvature import _curvature, curvature, smoothed

RAW = CurvatureConfig(smoothing_sigma_px=0.0)


@pytest.mark.parametrize("shape", [(3, 3), (3, 11), (17, 23), (1, 1), (1, 5), (2, 2), (5, 1)])
def test_kernel_equals_its_twin(rng, shape):
    f = rng.uniform(0, 255, shape).astype(np.float32)
    kappa = np.full(shape, np.nan, np.float32)
    _curvature(f, kappa)
    expected = reference.curvature(f)
    np.testing.assert_allclose(kappa, expected, rtol=1e-4, atol=1e-5 * max(1.0, np.abs(expected).max()))


def test_nan_spreads_to_its_neighbours_only(rng):
    f = rng.uniform(0, 255, (9, 9)).astype(np.float32)
    f[4, 4] = np.nan
    kappa = np.zeros_like(f)
    _curvature(f, kappa)
    spoilt = np.isnan(kappa)
    assert spoilt[3:6, 3:6].all() and spoilt.sum() == 9


def test_a_ramp_has_no_curvature_and_a_circle_has_its_own():
    us = np.tile(np.arange(40, dtype=np.uint8), (30, 1))
    np.testing.assert_array_equal(curvature(us, RAW), 0.0)
    v, u = np.mgrid[:81, :81] - 40.0
    f = (0.05 * (u**2 + v**2)).astype(np.float32)  # |grad f| = 0.1 r, curvature of the circle 1 / r
    kappa = np.zeros_like(f)
    _curvature(f, kappa)
    r = np.hypot(u, v)[5:-5, 5:-5]
    np.testing.assert_allclose(kappa[5:-5, 5:-5], (0.1 * r) ** 3 * np.divide(1, r, where=r > 0, out=np.zeros_like(r)), rtol=1e-3, atol=1e-3)


def test_smoothing_is_a_normalised_gaussian(rng):
    impulse = np.zeros((41, 41), np.uint8)
    impulse[20, 20] = 200
    f = smoothed(impulse, CurvatureConfig(smoothing_sigma_px=2.0))
    v, u = np.mgrid[:41, :41] - 20.0
    np.testing.assert_allclose(f, 200 * np.exp(-(u**2 + v**2) / 8) / (8 * np.pi), atol=0.02)
    np.testing.assert_allclose(f.sum(), 200, rtol=1e-5)
    np.testing.assert_array_equal(smoothed(impulse, RAW), impulse)


@pytest.mark.parametrize("offset", [-20, 1, 20])
def test_a_brightness_offset_changes_nothing(rng, offset):
    image = np.clip(texture(60, 80, rng), 30, 220)
    config = CurvatureConfig()
    a, b = curvature(image, config), curvature((image.astype(int) + offset).astype(np.uint8), config)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(a).max())


def test_a_gain_multiplies_by_its_cube(rng):
    image = texture(60, 80, rng) // 3
    a, b = curvature(image, CurvatureConfig()), curvature(image * 3, CurvatureConfig())
    np.testing.assert_allclose(27 * a, b, rtol=0, atol=1e-4 * np.abs(b).max())
    assert np.abs(a).max() > 1.0
