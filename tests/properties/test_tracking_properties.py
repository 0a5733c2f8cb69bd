# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vitamin3d.config import CurvatureConfig, ExtremaConfig
from vitamin3d.image.curvature import _curvature, curvature
from vitamin3d.image.extrema import detect_extrema, refine_extrema, select_free_extrema
from vitamin3d.tracking.dominant_flow import fit_affine_flow
from vitamin3d.tracking.extrema_tracking import one_per_pixel
from vitamin3d.types import Tracks

sides = st.integers(1, 14)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def pictures(draw, low=0, high=255):
    return draw(arrays(np.uint8, (draw(sides), draw(sides)), elements=st.integers(low, high)))


@given(pictures())
def test_curvature_equals_its_twin(image):
    kappa = curvature(image, CurvatureConfig(smoothing_sigma_px=0.0))
    expected = reference.curvature(image)
    np.testing.assert_allclose(kappa, expected, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(expected).max()))


@given(pictures(30, 200), st.integers(-30, 55))
def test_an_offset_changes_nothing(image, offset):
    kappa = curvature(image, CurvatureConfig())
    brighter = curvature((image.astype(int) + offset).astype(np.uint8), CurvatureConfig())
    np.testing.assert_allclose(brighter, kappa, rtol=0, atol=1e-3 + 1e-4 * np.abs(kappa).max())


@given(pictures(0, 63), st.integers(2, 4))
def test_a_gain_multiplies_by_its_cube(image, gain):
    kappa = curvature(image, CurvatureConfig())
    stronger = curvature((gain * image.astype(int)).astype(np.uint8), CurvatureConfig())
    np.testing.assert_allclose(stronger, gain**3 * kappa, rtol=0, atol=1e-3 + 1e-4 * np.abs(stronger).max())


@given(pictures())
def test_curvature_turns_with_the_picture(image):
    f = image.astype(np.float32)
    kappa, turned = np.empty_like(f), np.empty_like(np.ascontiguousarray(f.T))
    _curvature(f, kappa)
    _curvature(np.ascontiguousarray(f.T), turned)
    np.testing.assert_allclose(turned.T, kappa, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(kappa).max()))


@given(arrays(np.float32, st.tuples(sides, sides), elements=st.floats(-4, 4, width=16)), st.integers(1, 3))
def test_maxima_equal_their_twin_and_are_refined_within_half_a_pixel(kappa, border):
    found = detect_extrema(kappa, ExtremaConfig(min_curvature=0.0, border_px=border, min_roundness=0.0))
    assert {tuple(x) for x in found.tolist()} == reference.local_maxima(kappa, 0.0, border)
    assert (np.abs(refine_extrema(kappa, found) - found) <= 0.5).all()


@given(seeds, st.integers(0, 60), st.integers(0, 40), st.integers(1, 9))
def test_new_tracks_keep_their_distance(seed, count, live_count, distance):
    rng = np.random.default_rng(seed)
    extrema = np.unique(rng.integers(0, [70, 50], (count, 2)), axis=0).astype(np.int32).reshape(-1, 2)
    live = rng.uniform(0, [69, 49], (live_count, 2))
    config = ExtremaConfig(max_tracks=50, min_distance_px=float(distance))
    new = select_free_extrema(extrema, live, (50, 70), config)
    assert len(new) + live_count <= max(50, live_count)
    others = np.concatenate([np.rint(live), new])
    gaps = np.abs(new[:, None] - others[None]).max(axis=2)
    gaps[np.arange(len(new)), live_count + np.arange(len(new))] = 99
    assert gaps.min(initial=99) > distance // 2


@given(seeds)
def test_an_affine_flow_is_recovered_exactly(seed):
    rng = np.random.default_rng(seed)
    A, b = np.eye(2) + rng.uniform(-0.1, 0.1, (2, 2)), rng.uniform(-30, 30, 2)
    x = rng.uniform(0, [640, 480], (40, 2))
    A_found, b_found, residuals = fit_affine_flow(x, x @ A.T + b, 6.0, 20)
    np.testing.assert_allclose(A_found, A, atol=1e-7)
    np.testing.assert_allclose(b_found, b, atol=1e-4)
    assert residuals.max() < 1e-4


@given(seeds, st.integers(0, 40))
def test_merging_leaves_the_best_track_per_pixel(seed, count):
    rng = np.random.default_rng(seed)
    pixels, ids = rng.uniform(2, 8, (count, 2)), rng.permutation(100)[:count]
    ages, missed = rng.integers(0, 4, (2, count), np.int32)
    tracks = Tracks(ids, pixels, np.zeros(count, np.float32), ages, missed)
    best = {}
    for place, rank in zip(map(tuple, np.rint(pixels).astype(int).tolist()), zip(missed, -ages, ids, strict=True), strict=True):
        best[place] = min(best.get(place, rank), rank)
    merged = tracks.select(one_per_pixel(tracks, np.ones(count, np.bool_), (10, 10)))
    assert sorted(merged.ids.tolist()) == sorted(int(id_) for *_, id_ in best.values())
