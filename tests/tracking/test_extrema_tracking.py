# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import texture, warped
from scipy.spatial.transform import Rotation

from vitamin3d.config import CurvatureConfig, ExtremaConfig, ExtremaTrackingConfig
from vitamin3d.image.curvature import curvature
from vitamin3d.image.extrema import detect_extrema, refine_extrema
from vitamin3d.tracking.extrema_tracking import (
    _climb_all,
    one_per_pixel,
    predict_by_dense_flow,
    predict_by_dominant_flow,
    track_extrema,
)
from vitamin3d.types import DominantFlow, Tracks

CONFIG = ExtremaTrackingConfig()
ANY_SHAPE = dataclasses.replace(CONFIG, min_roundness=0.0)
FIXED_GATE = dataclasses.replace(CONFIG, gate_medians=0.0)


def tracks_at(pixels, ids=None, ages=None, missed=None):
    n = len(pixels)
    filled = (np.zeros(n, np.int32) if values is None else np.array(values, np.int32) for values in (ages, missed))
    return Tracks(np.arange(n) if ids is None else np.array(ids), np.array(pixels, float), np.ones(n, np.float32), *filled)


def climbed(kappa, predicted, config):
    n = len(predicted)
    out, values, distances = np.empty((n, 2)), np.empty(n, np.float32), np.empty(n)
    weight, sigma = config.prediction_weight, config.prediction_sigma_px
    _climb_all(kappa, predicted, weight, sigma, config.max_steps, config.gate_px, config.min_roundness, out, values, distances)
    return out, values, distances


@pytest.mark.parametrize("shape", [(3, 3), (3, 30), (25, 31)])
@pytest.mark.parametrize(
    "config",
    [
        ANY_SHAPE,
        dataclasses.replace(ANY_SHAPE, gate_px=8.0, max_steps=2, prediction_weight=2.0),
        dataclasses.replace(CONFIG, gate_px=2.5, min_roundness=0.6),
    ],
)
def test_climbing_equals_its_twin(rng, shape, config):
    kappa = rng.standard_normal(shape).astype(np.float32)
    predicted = rng.uniform(-2, [shape[1] + 1, shape[0] + 1], (200, 2))
    out, values, distances = climbed(kappa, predicted, config)
    settings = config.prediction_weight, config.prediction_sigma_px, config.max_steps, config.gate_px, config.min_roundness
    for i, p in enumerate(predicted):
        twin = reference.climbed(kappa, p, *settings)
        assert distances[i] == pytest.approx(np.inf if twin is None else np.linalg.norm(twin - p), abs=1e-4), (p, twin)
        np.testing.assert_allclose(out[i], p if twin is None else twin, atol=1e-4)
        assert (values[i] > 0) == np.isfinite(distances[i])
    assert not np.isfinite(distances).all() and (np.isfinite(distances).any() or shape == (3, 3))


def test_the_prediction_pulls_at_an_even_ridge():
    kappa = np.zeros((21, 41), np.float32)
    kappa[10] = 1.0
    predicted = np.array([[17.0, 10.0], [30.2, 10.0]])
    out, _, distances = climbed(kappa, predicted, ANY_SHAPE)
    np.testing.assert_allclose(out, [[17, 10], [30, 10]], atol=0.5)
    np.testing.assert_allclose(distances, np.linalg.norm(out - predicted, axis=1), atol=1e-12)
    assert np.isinf(climbed(kappa, predicted, CONFIG)[2]).all()


def test_nan_curvature_is_never_found(rng):
    kappa = np.full((20, 20), np.nan, np.float32)
    assert np.isinf(climbed(kappa, rng.uniform(3, 17, (20, 2)), CONFIG)[2]).all()


def test_flow_samples_equal_their_twin(rng):
    flow = rng.standard_normal((7, 9, 2)).astype(np.float32)
    pixels = np.concatenate([rng.uniform(-2, [11, 9], (40, 2)), [[0, 0], [8, 6], [3, 2]]])
    expected = [p + reference.bilinear(flow.astype(float), *p) for p in pixels]
    np.testing.assert_allclose(predict_by_dense_flow(pixels, flow), expected, atol=1e-2)
    interior = pixels[((pixels > 0) & (pixels < [7.9, 5.9])).all(axis=1)]
    expected = [p + reference.bilinear(flow.astype(float), *p) for p in interior]
    np.testing.assert_allclose(predict_by_dense_flow(interior, flow), expected, atol=1e-6)
    assert predict_by_dense_flow(pixels[:0], flow).shape == (0, 2)


def test_a_reduced_flow_is_sampled_on_the_pixel_centres_of_the_picture():
    u, v = np.meshgrid(np.arange(12.0), np.arange(10.0))
    flow = np.stack([0.1 * u, 0.05 * v], axis=2).astype(np.float32)  # in reduced pixels; full ones: (x + 0.5) / 3 - 0.5
    pixels = np.array([[10.0, 7.0], [16.0, 22.0]])
    reduced = (pixels + 0.5) / 3 - 0.5
    np.testing.assert_allclose(predict_by_dense_flow(pixels, flow, 3), pixels + 3 * reduced * [0.1, 0.05], atol=1e-5)


def test_an_extremum_beyond_the_gate_is_a_miss():
    kappa = np.zeros((40, 200), np.float32)
    kappa[20, 10:190:10] = 5.0
    seen = np.array([[u + 0.1, 20.0] for u in range(10, 190, 10)])
    seen[3, 0] += 1.0
    tracks = tracks_at(seen)
    moved = track_extrema(tracks, tracks.pixels, kappa, dataclasses.replace(CONFIG, gate_px=0.5))
    assert moved.missed[3] == 1 and np.delete(moved.missed, 3).max() == 0


def test_dominant_flow_prediction_is_equation_4():
    flow = DominantFlow(np.array([[1.0, 0.5], [0.0, 2.0]]), np.array([10.0, -1.0]), 1.0)
    np.testing.assert_allclose(predict_by_dominant_flow(np.array([[2.0, 4.0]]), flow), [[14.0, 7.0]])


@pytest.fixture(scope="module")
def moving():
    """Two pictures by a known warp, the extrema of the first and where they must be in the second."""
    rng = np.random.default_rng(8)
    A = 1.005 * Rotation.from_euler("z", 0.8, degrees=True).as_matrix()[:2, :2]
    b = np.array([2.7, -3.4])
    image = texture(240, 320, rng, 4.0)
    kappa_0, kappa_1 = (curvature(x, CurvatureConfig()) for x in (image, warped(image, A, b)))
    pixels = refine_extrema(kappa_0, detect_extrema(kappa_0, ExtremaConfig(border_px=20, min_curvature=2.0)))
    return pixels, pixels @ A.T + b, kappa_1


def test_extrema_are_followed_through_a_known_warp(moving, rng):
    pixels, truth, kappa = moving
    predicted = truth + rng.uniform(-0.35, 0.35, truth.shape)
    found = track_extrema(tracks_at(pixels), predicted, kappa, CONFIG)
    assert len(pixels) > 100
    seen = found.select(found.missed == 0)
    near = np.linalg.norm(seen.pixels - truth[seen.ids], axis=1) < 0.5
    assert near.sum() >= 0.9 * len(pixels)
    assert np.median(np.linalg.norm(seen.pixels - truth[seen.ids], axis=1)) < 0.15
    assert (seen.ages == 1).all() and (seen.kappa > 0).all()


@pytest.mark.parametrize(("config", "limit_px"), [(CONFIG, CONFIG.max_gate_px), (FIXED_GATE, FIXED_GATE.gate_px)])
def test_a_wrong_prediction_is_a_miss_not_a_jump(moving, config, limit_px):
    pixels, truth, kappa = moving
    found = track_extrema(tracks_at(pixels), truth + np.array([0.0, 6.0]), kappa, config)
    seen = found.select(found.missed == 0)
    assert (np.linalg.norm(seen.pixels - truth[seen.ids] - [0.0, 6.0], axis=1) <= limit_px).all()
    assert len(seen) < 0.6 * len(pixels)


def columns(*distances, missed=None):
    """Tracks of lonely maxima in a row, predicted so many pixels beside them; and their curvature."""
    v, u = np.mgrid[:40, : 20 * len(distances) + 20]
    kappa = (5.0 * np.exp(-((u - np.clip(20 * np.rint(u / 20), 20, u.max() - 19)) ** 2 + (v - 20) ** 2) / 8)).astype(np.float32)
    return tracks_at([[20.0 * (n + 1) + d, 20.0] for n, d in enumerate(distances)], missed=missed), kappa


def tracked(tracks, kappa, config=CONFIG):
    return track_extrema(tracks, tracks.pixels, kappa, config)


@pytest.mark.parametrize(
    ("distances", "gate_px"),
    [
        ([0.1] * 7, 1.05),  # never narrower than that
        ([1.2] * 7, 1.5),  # 1.25 medians
        ([2.4] * 7, 2.5),  # never wider than that
        ([0.4] * 3 + [1.4] * 4, 1.75),
        ([0.4] * 4 + [1.4] * 3, 1.05),
    ],
)
def test_the_gate_is_as_wide_as_the_flow_is_inexact(distances, gate_px):
    for last, is_found in ((gate_px - 0.04, True), (gate_px + 0.04, False)):
        tracks, kappa = columns(*distances, last, missed=[0] * len(distances) + [1])  # what coasts does not tell of the flow
        moved = tracked(tracks, kappa)
        assert (moved.missed[-1] == 0) == is_found, (last, moved.missed)
        np.testing.assert_allclose(moved.pixels[-1, 0], 20.0 * len(tracks) + (0.0 if is_found else last))
        assert moved.kappa[-1] == (5.0 if is_found else tracks.kappa[-1])
    assert tracked(*columns(*distances, 1.09), FIXED_GATE).missed[-1] == 1


def test_the_gate_of_tracks_that_all_coast_or_find_nothing_is_the_narrowest():
    assert tracked(*columns(1.0, 1.2, missed=[1, 1])).missed.tolist() == [0, 2]
    tracks, kappa = columns(1.0, 1.2)
    assert tracked(tracks, 0.0 * kappa).missed.tolist() == [1, 1]


def test_a_track_coasts_so_many_frames_and_is_then_dropped():
    flat = np.zeros((40, 40), np.float32)
    start = tracks_at([[20.0, 20.0]], ids=[7], ages=[5])
    coasting = track_extrema(start, np.array([[21.0, 19.0]]), flat, CONFIG)
    assert (coasting.ids[0], coasting.missed[0], coasting.ages[0]) == (7, 1, 6)
    np.testing.assert_array_equal(coasting.pixels, [[21.0, 19.0]])
    assert coasting.kappa[0] == start.kappa[0]
    for _ in range(CONFIG.coast_frames - 1):
        coasting = track_extrema(coasting, np.array([[22.0, 18.0]]), flat, CONFIG)
        assert len(coasting) == 1
    assert len(track_extrema(coasting, np.array([[22.0, 18.0]]), flat, CONFIG)) == 0
    assert len(track_extrema(start, np.array([[21.0, 19.0]]), flat, dataclasses.replace(CONFIG, coast_frames=0))) == 0


def test_a_coasting_track_that_is_seen_again_counts_from_zero():
    kappa = np.zeros((40, 40), np.float32)
    kappa[20, 21] = 5.0
    found = track_extrema(tracks_at([[20.0, 20.0]], missed=[1]), np.array([[20.6, 20.2]]), kappa, CONFIG)
    assert found.missed[0] == 0 and found.kappa[0] == 5.0
    np.testing.assert_allclose(found.pixels, [[21.0, 20.0]])


def test_tracks_that_leave_the_picture_end():
    kappa = np.zeros((40, 50), np.float32)
    predicted = np.array([[-1.0, 20.0], [25.0, 41.0], [0.5, 20.0], [25.0, 20.0], [48.5, 5.0]])
    found = track_extrema(tracks_at(np.full((5, 2), 20.0)), predicted, kappa, CONFIG)
    assert found.ids.tolist() == [3]


def test_tracks_that_meet_are_merged_into_the_oldest():
    kappa = np.zeros((40, 40), np.float32)
    kappa[20, 20] = 5.0
    predicted = np.array([[20.4, 20.0], [19.7, 20.3], [20.0, 19.6]])
    found = track_extrema(tracks_at(predicted, ids=[4, 9, 2], ages=[3, 8, 3]), predicted, kappa, CONFIG)
    assert found.ids.tolist() == [9] and found.ages.tolist() == [9]


@pytest.mark.parametrize(
    ("ids", "ages", "missed", "winner"), [([4, 9], [3, 8], [0, 1], 4), ([4, 9], [3, 8], [0, 0], 9), ([9, 4], [3, 3], [0, 0], 4)]
)
def test_a_seen_track_wins_then_the_oldest_then_the_first(ids, ages, missed, winner):
    tracks = tracks_at([[5.1, 6.0], [4.9, 6.2]], ids, ages, missed)
    assert tracks.ids[one_per_pixel(tracks, np.ones(2, np.bool_), (40, 40))].tolist() == [winner]
    assert one_per_pixel(tracks, np.array([False, True]), (40, 40)).tolist() == [False, True]


def test_merging_keeps_the_order_and_all_that_do_not_meet(rng):
    pixels = rng.permutation(np.array([(u, v) for u in range(20) for v in range(15)], float))
    keep = rng.random(300) < 0.7
    np.testing.assert_array_equal(one_per_pixel(tracks_at(pixels), keep, (15, 20)), keep)


def test_no_tracks():
    empty = track_extrema(Tracks.empty(), np.zeros((0, 2)), np.zeros((9, 9), np.float32), CONFIG)
    assert len(empty) == 0 and empty.pixels.shape == (0, 2)
