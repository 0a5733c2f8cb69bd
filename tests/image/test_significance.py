# SPDX-License-Identifier: Apache-2.0
"""How far maxima of the curvature stand above the noise."""

import dataclasses

import cv2
import numpy as np
import pytest
from scenes import texture

from vitamin3d.config import Config, CurvatureConfig, ExtremaConfig, paper_config
from vitamin3d.image.curvature import curvature_of, smoothed
from vitamin3d.image.extrema import detect_extrema
from vitamin3d.image.significance import bend_noise, is_significant, significance
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame

CONFIG, SIGMA_PX = ExtremaConfig(), CurvatureConfig().smoothing_sigma_px
CORNERS = [[121, 101], [218, 101], [121, 178], [218, 178]]
"""Where a dark box's are, rounded off by the blur."""


def noisy(clean, deviation, rng):
    return np.clip(np.rint(clean + deviation * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)


def box(grey=60.0):
    """A box on a wall."""
    picture = np.full((240, 320), 200.0)
    picture[100:180, 120:220] = grey
    return picture


def maxima(picture, sigma_px=SIGMA_PX, **settings):
    """All maxima of a picture's curvature, strongest first; what they stand above the noise; their curvatures."""
    f = smoothed(picture, CurvatureConfig(smoothing_sigma_px=sigma_px))
    kappa = curvature_of(f)
    extrema = detect_extrema(kappa, dataclasses.replace(CONFIG, min_curvature=0.0, **settings))
    return extrema, significance(f, kappa, extrema, sigma_px), kappa[extrema[:, 1], extrema[:, 0]]


# --- the noise -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 1.9, 2.2, 2.8])
@pytest.mark.parametrize("deviation", [1.0, 4.0, 12.0])
def test_the_noise_is_the_deviation_of_second_differences_of_blurred_noise(rng, sigma_px, deviation):
    f = cv2.GaussianBlur((128 + deviation * rng.standard_normal((480, 640))).astype(np.float32), (0, 0), sigma_px)
    both = [(f[1:-1, 2:] - 2 * f[1:-1, 1:-1] + f[1:-1, :-2]).std(), (f[2:, 1:-1] - 2 * f[1:-1, 1:-1] + f[:-2, 1:-1]).std()]
    assert bend_noise(f).shape == (256,)
    np.testing.assert_allclose(bend_noise(f), np.mean(both), rtol=0.16)


def test_noise_in_places_is_not_the_texture_beside_it(rng):
    plain, half = np.full((480, 640), 126.0), np.full((480, 640), 126.0)
    half[:, :320] = texture(480, 320, rng, 2.0)
    noise, beside = (bend_noise(smoothed(noisy(picture, 3.0, rng), CurvatureConfig()))[126] for picture in (plain, half))
    assert beside == pytest.approx(noise, rel=0.15)


def test_noise_of_bright_and_of_dark_places_is_told_apart(rng):
    greys, deviations = np.array([40.0, 120.0, 200.0]), np.array([1.0, 3.0, 9.0])
    clean, spread = (np.repeat(values, 160)[None].repeat(480, axis=0) for values in (greys, deviations))
    f = cv2.GaussianBlur((clean + spread * rng.standard_normal(clean.shape)).astype(np.float32), (0, 0), SIGMA_PX)
    noise = bend_noise(f)
    for grey, deviation, at in zip(greys, deviations, (40, 200, 360), strict=True):
        inside = f[:, at:][:, :80]
        truth = (inside[:, 2:] - 2 * inside[:, 1:-1] + inside[:, :-2]).std()
        assert noise[int(grey)] == pytest.approx(truth, rel=0.2), deviation
    assert noise[40] < noise[80] < noise[120] < noise[160] < noise[200]  # between the known ones it rises
    assert (noise[0], noise[255]) == (noise[40], noise[200])


@pytest.mark.parametrize("shape", [(3, 3), (17, 33), (40, 5)])
def test_pictures_of_a_stamps_size_have_noise_too(rng, shape):
    for f in (rng.uniform(0, 255, shape).astype(np.float32), np.zeros(shape, np.float32)):
        assert bend_noise(f).shape == (256,) and np.isfinite(bend_noise(f)).all() and (bend_noise(f) >= 0).all()


# --- maxima ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deviation", [0.5, 1.0, 4.0])
def test_a_strong_corner_is_significant_and_noise_along_an_edge_is_not(rng, deviation):
    extrema, values, strengths = maxima(noisy(box(), deviation, rng))
    at_corner = np.abs(extrema[:, None] - np.array(CORNERS)).max(axis=2).min(axis=1) <= 3
    on_edge = ~at_corner & (strengths > 100 * CONFIG.min_curvature)  # what only a floor of curvature would take
    assert at_corner[values > CONFIG.significance].all() and (values[:4] > 30).all() and at_corner[:4].all()
    assert on_edge.sum() >= 10 and values[on_edge].max() < CONFIG.significance


@pytest.mark.parametrize("sigma_px", [1.0, 1.9, 2.8])
@pytest.mark.parametrize("deviation", [1.0, 4.0, 12.0])
def test_maxima_of_noise_alone_are_not_significant(rng, sigma_px, deviation):
    extrema, values, _ = maxima(noisy(np.full((240, 320), 128.0), deviation, rng), sigma_px)
    assert len(extrema) > 1000 and (values < 5.0).mean() > 0.999 and np.median(values) < 2.0


def test_a_weak_corner_drowns_in_noise(rng):
    """The same box with a tenth of the contrast: above the noise of a good camera, not above that of a bad one."""
    for deviation, is_above in ((0.5, True), (8.0, False)):
        extrema, values, _ = maxima(noisy(box(186.0), deviation, rng))
        at_corner = np.abs(extrema[:, None] - np.array(CORNERS)).max(axis=2).min(axis=1) <= 3
        assert (values[at_corner].max() > 5.0) == is_above


def test_contrast_that_noise_shares_does_not_change_it(rng):
    f = smoothed(noisy(0.5 * box(), 2.0, rng), CurvatureConfig())
    extrema = detect_extrema(curvature_of(f), dataclasses.replace(CONFIG, min_curvature=0.0))
    values, of_doubled = (significance(x, curvature_of(x), extrema, SIGMA_PX) for x in (f, np.float32(2.0) * f))
    np.testing.assert_allclose(of_doubled[:4], values[:4], rtol=0.05)
    assert significance(f, curvature_of(f), extrema[:0], SIGMA_PX).shape == (0,)


# --- which become tracks ---------------------------------------------------------------------------------------------


def chosen(values, **settings):
    return is_significant(np.asarray(values), dataclasses.replace(CONFIG, **{"significant_share": 0.0, **settings}))


def test_where_enough_maxima_are_significant_exactly_those_are_kept(rng):
    values = rng.uniform(0, 10, 3000)
    np.testing.assert_array_equal(chosen(values, significance=5.0, significant_wanted=1000), values >= 5.0)
    np.testing.assert_array_equal(chosen(values, significance=7.0, significant_wanted=500), values >= 7.0)


def test_where_fewer_are_the_best_are_kept_up_to_the_number_wanted(rng):
    values = rng.uniform(0, 10, 3000)
    for wanted in (1, 10, 700, 2999):
        kept = chosen(values, significance=9.9999, significant_wanted=wanted)
        best = np.zeros(3000, np.bool_)
        best[np.argsort(values)[-wanted:]] = True
        np.testing.assert_array_equal(kept, best | (values >= 9.9999))
    assert chosen(values, significance=5.0, significant_wanted=3000).all()
    assert chosen(values[:20], significance=5.0, significant_wanted=3000).all() and chosen([]).shape == (0,)


def test_of_many_maxima_a_share_is_kept(rng):
    values = rng.uniform(0, 10, 3000)
    assert chosen(values, significance=9.9999, significant_wanted=100, significant_share=0.3).sum() == 900
    assert chosen(values, significance=9.9999, significant_wanted=1200, significant_share=0.3).sum() == 1200
    assert chosen(values, significance=0.1, significant_wanted=100, significant_share=0.3).sum() == (values >= 0.1).sum()


def test_where_none_are_wanted_none_but_the_significant_are_kept(rng):
    values = rng.uniform(0, 10, 300)
    np.testing.assert_array_equal(chosen(values, significance=5.0, significant_wanted=0), values >= 5.0)


# --- in the front end ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def grainy():
    """A picture of soft texture and noise with thousands of maxima."""
    rng = np.random.default_rng(2)
    return Frame(0, 0, noisy(texture(480, 640, rng, 4.0), 1.5, rng))


def found(frame, **settings):
    """The extrema of a picture, with floors so low that noise passes them."""
    low = {"wanted": 10**6, "lowest_curvature": 1e-6, "noise_curvature": 0.0, "min_roundness": 0.0, "significant_share": 0.0}
    config = dataclasses.replace(Config(), extrema=ExtremaConfig(**(low | settings)))
    return FrontEnd(config).process(frame).extrema


def test_the_front_end_keeps_what_is_significant(grainy):
    every = found(grainy, significance=0.0)
    f = smoothed(grainy.image, CurvatureConfig())
    values = significance(f, curvature_of(f), every, SIGMA_PX)
    for bound, wanted in ((5.0, 10), (10.0, 10), (1e6, 800)):
        kept = found(grainy, significance=bound, significant_wanted=wanted)
        np.testing.assert_array_equal(kept, every[chosen(values, significance=bound, significant_wanted=wanted)])
        assert wanted <= len(kept) < 0.8 * len(every), bound


def test_a_significance_of_zero_switches_it_off(grainy):
    f = smoothed(grainy.image, CurvatureConfig())
    every = detect_extrema(curvature_of(f), dataclasses.replace(CONFIG, min_curvature=1e-6, min_roundness=0.0))
    assert len(every) > 2000 > len(found(grainy)) >= CONFIG.significant_wanted
    np.testing.assert_array_equal(found(grainy, significance=0.0), every)


def test_the_paper_knows_no_significance(grainy):
    config = paper_config()
    every = detect_extrema(curvature_of(smoothed(grainy.image, config.curvature)), config.extrema)
    loud = dataclasses.replace(grainy, image=noisy(np.full((480, 640), 128.0), 20.0, np.random.default_rng(3)))
    np.testing.assert_array_equal(FrontEnd(config).process(grainy).extrema, every)
    every = detect_extrema(curvature_of(smoothed(loud.image, config.curvature)), config.extrema)
    np.testing.assert_array_equal(FrontEnd(config).process(loud).extrema, every)
