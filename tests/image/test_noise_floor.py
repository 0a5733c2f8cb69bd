# SPDX-License-Identifier: Apache-2.0
"""Noise measured in pictures, and the floor of curvature that follows it."""

import dataclasses

import cv2
import numpy as np
import pytest
from scenes import texture

from vitamin3d.config import CurvatureConfig, ExtremaConfig
from vitamin3d.image.curvature import curvature
from vitamin3d.image.noise_floor import curvature_floor, lowest_floor, noise_deviation, smoothing_for

CONFIG, SMOOTHING = ExtremaConfig(), CurvatureConfig()
LEVELS = (0.0, 1.0, 2.0, 4.0, 8.0)


def noisy(clean, deviation, rng):
    return np.clip(np.rint(clean + deviation * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)


def room(rng):
    """A wall of plain grey on the left, then shadows, edges, and a poster."""
    picture = np.full((480, 640), 140.0)
    picture[:, 300:] = np.linspace(60, 200, 340)
    picture[200:, 250:400] = 70.0
    cv2.line(picture, (0, 30), (639, 300), 230.0, 3)
    picture[60:260, 430:620] = texture(200, 190, rng, 2.0)
    return picture


# --- noise -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deviation", [1.0, 2.0, 4.0, 8.0, 16.0])
def test_noise_on_grey_is_measured(rng, deviation):
    assert noise_deviation(noisy(np.full((480, 640), 128.0), deviation, rng)) == pytest.approx(np.hypot(deviation, 12**-0.5), rel=0.15)


@pytest.mark.parametrize("deviation", [1.0, 2.0, 4.0, 8.0])
def test_noise_is_measured_in_pictures_with_texture_in_places(rng, deviation):
    assert noise_deviation(noisy(room(rng), deviation, rng)) == pytest.approx(np.hypot(deviation, 12**-0.5), rel=0.15)


@pytest.mark.parametrize("deviation", [2.0, 4.0, 8.0])
def test_noise_is_measured_in_pictures_of_soft_texture(rng, deviation):
    assert noise_deviation(noisy(texture(480, 640, rng, 6.0), deviation, rng)) == pytest.approx(deviation, rel=0.15)


def test_the_estimate_is_that_of_the_obvious_sum(rng):
    image = rng.integers(0, 256, (64, 96), np.uint8)
    padded = np.pad(image.astype(float), 1, mode="symmetric")
    weights = ((1, -2, 1), (-2, 4, -2), (1, -2, 1))
    rough = sum(w * padded[v : v + 64, u : u + 96] for v, row in enumerate(weights) for u, w in enumerate(row))
    blocks = np.abs(rough).reshape(2, 32, 3, 32).mean(axis=(1, 3))
    assert noise_deviation(image) == pytest.approx(np.sqrt(np.pi / 2) / 6 * np.quantile(blocks, 0.2), rel=1e-5)


def test_planes_and_edges_are_no_noise():
    v, u = np.mgrid[:240, :320]
    assert noise_deviation(np.full((240, 320), 9, np.uint8)) == noise_deviation((u // 2 * 2).astype(np.uint8)) == 0.0
    assert noise_deviation((200 * ((u > 90) ^ (v > 100))).astype(np.uint8)) == 0.0


def test_what_does_not_depend_on_the_noise_does_not_change_it(rng):
    grey = noisy(np.full((480, 640), 90.0), 3.0, rng)
    assert noise_deviation(grey + np.uint8(60)) == pytest.approx(noise_deviation(grey), rel=1e-6)
    assert noise_deviation(2 * grey) == pytest.approx(2 * noise_deviation(grey), rel=1e-6)
    assert 0 < noise_deviation(cv2.GaussianBlur(grey, (0, 0), 1.5)) < 0.3


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (31, 33), (64, 3)])
def test_pictures_of_a_stamps_size_pass(rng, shape):
    assert 0 <= noise_deviation(rng.integers(0, 256, shape, np.uint8)) < 200


# --- the blur --------------------------------------------------------------------------------------------------------


def test_the_blur_widens_with_the_noise_and_stays_within_its_bounds():
    widths = [smoothing_for(noise, SMOOTHING).smoothing_sigma_px for noise in np.linspace(0, 20, 81)]
    assert (np.diff(widths) >= 0).all() and (widths[0], widths[-1]) == (SMOOTHING.smoothing_sigma_px, SMOOTHING.max_smoothing_sigma_px)
    assert smoothing_for(SMOOTHING.quiet_noise, SMOOTHING) == SMOOTHING
    assert smoothing_for(SMOOTHING.quiet_noise + 1.0, SMOOTHING).smoothing_sigma_px == pytest.approx(2.2)
    narrow = dataclasses.replace(SMOOTHING, max_smoothing_sigma_px=1.0)
    assert smoothing_for(20.0, narrow).smoothing_sigma_px == narrow.smoothing_sigma_px


# --- the floor -------------------------------------------------------------------------------------------------------


def test_the_lowest_floor_rises_with_noise_from_the_settings_bound():
    floors = [lowest_floor(noise, 1.9, CONFIG) for noise in LEVELS]
    assert floors[0] == floors[1] == CONFIG.lowest_curvature and (np.diff(floors[1:]) > 0).all()
    assert floors[-1] == pytest.approx(CONFIG.noise_curvature * 8**3)
    blurred = [lowest_floor(8.0, sigma, CONFIG) for sigma in (0.0, 0.5, 1.0, 1.9, 2.8)]
    assert (np.diff(blurred) <= 0).all() and np.isfinite(blurred).all()


@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 1.9, 2.2, 2.8])
def test_noise_hardly_reaches_the_lowest_floor(rng, sigma_px):
    for deviation in (4.0, 8.0):
        kappa = curvature(noisy(np.full((480, 640), 128.0), deviation, rng), CurvatureConfig(smoothing_sigma_px=sigma_px))
        floor = lowest_floor(deviation, sigma_px, dataclasses.replace(CONFIG, lowest_curvature=0.0))
        assert (kappa > floor).mean() < 1e-3 < (kappa > 0.1 * floor).mean()


def test_the_floor_sinks_until_enough_maxima_are_above_it():
    strengths = np.array([9.0, 5.0, 0.12, 0.07, 0.03], np.float32)
    for wanted, floor in ((1, 0.15), (2, 0.15), (3, 0.12), (4, 0.07), (5, 0.03), (6, 0.02), (3000, 0.02)):
        assert curvature_floor(strengths, 0.02, dataclasses.replace(CONFIG, wanted=wanted)) == pytest.approx(floor), wanted
    assert curvature_floor(strengths[:0], 0.02, CONFIG) == 0.02


@pytest.mark.parametrize("lowest", [0.02, 0.1, 0.15, 0.9])
def test_the_floor_stays_between_the_lowest_and_the_usual(rng, lowest):
    """Where the noise reaches above the usual floor, it is that of the noise."""
    strengths = np.sort(rng.exponential(0.2, 5000))[::-1].astype(np.float32)
    for wanted in (1, 1000, 3000, 5000, 9000):
        floor = curvature_floor(strengths[strengths > lowest], lowest, dataclasses.replace(CONFIG, wanted=wanted))
        assert lowest <= floor <= max(lowest, CONFIG.min_curvature)
