# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import texture

from vitamin3d.config import CurvatureConfig, ExtremaConfig
from vitamin3d.image.curvature import curvature
from vitamin3d.image.extrema import (
    CELL_PX,
    detect_extrema,
    refine_extrema,
    roundness,
    select_free_extrema,
    strongest_first,
    subpixel_offset,
)

LOW = ExtremaConfig(min_curvature=0.0, border_px=1, min_roundness=0.0)


def as_set(extrema):
    return {(int(u), int(v)) for u, v in extrema}


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (3, 3), (3, 20), (31, 17), (64, 48)])
def test_maxima_equal_their_twin(rng, shape):
    kappa = rng.standard_normal(shape).astype(np.float32)
    found = detect_extrema(kappa, LOW)
    assert as_set(found) == reference.local_maxima(kappa, 0.0, 1)
    assert len(as_set(found)) == len(found)


def test_maxima_on_plateaus_equal_their_twin(rng):
    for _ in range(20):
        kappa = rng.integers(0, 3, (12, 15)).astype(np.float32)
        assert as_set(detect_extrema(kappa, LOW)) == reference.local_maxima(kappa, 0.0, 1)


def test_the_buffer_holds_the_densest_picture():
    kappa = np.ones((21, 31), np.float32)
    kappa[1::2, 1::2] = 2.0
    assert len(detect_extrema(kappa, LOW)) == 10 * 15


def test_nan_is_never_a_maximum(rng):
    kappa = rng.standard_normal((20, 20)).astype(np.float32)
    kappa[5, 5] = kappa[10, 3:9] = np.nan
    assert as_set(detect_extrema(kappa, LOW)) == reference.local_maxima(kappa, 0.0, 1)
    assert len(detect_extrema(np.full((9, 9), np.nan, np.float32), LOW)) == 0


def test_strongest_come_first_and_floor_and_border_hold(rng):
    kappa = curvature(texture(90, 120, rng), CurvatureConfig())
    config = ExtremaConfig(min_curvature=0.5, border_px=9, min_roundness=0.0)
    found = detect_extrema(kappa, config)
    values = kappa[found[:, 1], found[:, 0]]
    assert len(found) > 30
    assert (np.diff(values) <= 0).all() and values.min() > 0.5
    assert found.min() >= 9 and (found < [120 - 9, 90 - 9]).all()
    assert found.dtype == np.int32
    assert as_set(found) == reference.local_maxima(kappa, 0.5, 9)


def test_equal_strengths_keep_their_order(rng):
    strengths = rng.choice(np.float32([1e-30, 0.15, 0.2, 3.0, 1e30]), 200)
    np.testing.assert_array_equal(strongest_first(strengths), np.argsort(-strengths, kind="stable"))
    assert len(strongest_first(strengths[:0])) == 0


def test_roundness_is_that_of_the_hessian(rng):
    kappa = rng.standard_normal((30, 30)).astype(np.float32)
    for u, v in rng.integers(1, 29, (50, 2)):
        assert roundness(kappa, u, v) == pytest.approx(reference.roundness(kappa, u, v), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4])
def test_roundness_of_a_quadric_is_that_of_its_axes(angle):
    v, u = np.mgrid[-3:4, -3:4].astype(float)
    along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    for axes in ((1.0, 1.0), (1.0, 0.25), (1.0, 0.0)):
        kappa = 50 - axes[0] * across**2 - axes[1] * along**2
        assert roundness(kappa, 3, 3) == pytest.approx(4 * axes[0] * axes[1] / sum(axes) ** 2, abs=1e-9)


def test_maxima_on_ridges_are_left_out(rng):
    kappa = curvature(texture(90, 120, rng), CurvatureConfig())
    found = as_set(detect_extrema(kappa, ExtremaConfig(min_curvature=0.5, border_px=9, min_roundness=0.7)))
    every = reference.local_maxima(kappa, 0.5, 9)
    assert found == {(u, v) for u, v in every if reference.roundness(kappa, u, v) >= 0.7}
    assert 20 < len(found) < len(every)


def test_a_flat_picture_has_no_extrema():
    assert len(detect_extrema(curvature(np.full((40, 40), 77, np.uint8), CurvatureConfig()), ExtremaConfig())) == 0


@pytest.mark.parametrize("samples", [(0.0, 1.0, 0.5), (3.0, 4.0, 3.9), (1.0, 1.0, 1.0), (2.0, 1.0, 2.0), (0.9, 1.0, 1.0), (0.0, 1.0, 5.0)])
def test_subpixel_offset_is_that_of_the_parabola(samples):
    assert subpixel_offset(*samples) == pytest.approx(reference.parabola_maximum(*samples), abs=1e-9)


def test_refinement_finds_the_top_of_a_quadric():
    v, u = np.mgrid[:9, :9].astype(float)
    kappa = (10 - (u - 4.3) ** 2 - 2 * (v - 3.8) ** 2).astype(np.float32)
    np.testing.assert_allclose(refine_extrema(kappa, np.array([[4, 4]])), [[4.3, 3.8]], atol=1e-5)
    assert refine_extrema(kappa, np.zeros((0, 2), np.int32)).shape == (0, 2)


@pytest.mark.parametrize("distance", [1.0, 4.0, 7.0])
def test_selection_equals_its_twin(rng, distance):
    extrema = rng.permutation(np.array([(u, v) for u in range(97) for v in range(75)], np.int32))[:600]
    live = rng.uniform(0, [96, 74], (80, 2))
    free = reference.free_extrema(extrema, live, (75, 97), int(distance) // 2)
    expected = reference.emptiest_cells_first(free, live, CELL_PX)
    assert 10 < len(expected) < 600
    for room in (7, 10_000):
        config = ExtremaConfig(max_tracks=len(live) + room, min_distance_px=distance)
        found = select_free_extrema(extrema, live, (75, 97), config)
        assert [tuple(x) for x in found.tolist()] == expected[:room]


def test_nothing_is_selected_without_room_or_extrema(rng):
    extrema, live = np.array([[10, 10], [50, 50]], np.int32), rng.uniform(0, 60, (5, 2))
    assert len(select_free_extrema(extrema, live, (60, 60), ExtremaConfig(max_tracks=5))) == 0
    assert len(select_free_extrema(extrema, live, (60, 60), ExtremaConfig(max_tracks=4))) == 0
    assert len(select_free_extrema(extrema[:0], live, (60, 60), ExtremaConfig())) == 0


def test_all_are_free_in_an_empty_picture():
    extrema = np.array([[10, 10], [50, 50], [11, 11]], np.int32)
    found = select_free_extrema(extrema, np.zeros((0, 2)), (60, 60), ExtremaConfig(min_distance_px=4.0))
    assert found.tolist() == [[10, 10], [50, 50]]


def test_live_tracks_outside_and_on_the_border_are_no_harm():
    live = np.array([[-3.0, 5.0], [59.0, 59.0], [59.4, -0.4], [63.0, 70.0]])
    extrema = np.array([[2, 5], [58, 58], [30, 30]], np.int32)
    found = select_free_extrema(extrema, live, (60, 60), ExtremaConfig())
    assert sorted(found.tolist()) == [[2, 5], [30, 30]]
