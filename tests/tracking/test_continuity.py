# SPDX-License-Identifier: Apache-2.0
"""Which picture continues which: the picture moves, blurs, brightens; or it is of something else."""

import dataclasses

import cv2
import numpy as np
import pytest
from scenes import texture, warped

from vitamin3d.config import Config, ContinuityConfig
from vitamin3d.tracking.continuity import FlowTracker, correlation, homography_flow, residual, step_of, view_of
from vitamin3d.tracking.front_end import dense_flow_solver

CONFIG = ContinuityConfig()
HEIGHT, WIDTH = 240, 320
BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)


def tracker(**settings):
    quick, patient = (dense_flow_solver(Config(), (HEIGHT, WIDTH), patient) for patient in (False, True))
    return FlowTracker(quick, patient, dataclasses.replace(CONFIG, **settings))


def followed(pictures, found=None, **settings):
    """For each of the pictures (or pairs of an index and a picture), which one it follows."""
    flows = found or tracker(**settings)
    pairs = [pair if isinstance(pair, tuple) else (index, pair) for index, pair in enumerate(pictures)]
    return [flows.follow(index, picture)[1] for index, picture in pairs]


@pytest.fixture(scope="module")
def scenes():
    """Three walls with corners, blobs and shadows, each wider than a picture."""
    walls = []
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        wall = texture(HEIGHT, 3 * WIDTH, rng, 5.0)
        for _ in range(400):
            (u, v), (w, h) = rng.integers(0, [3 * WIDTH, HEIGHT]), rng.integers(4, 25, 2)
            wall[v : v + h, u : u + w] = np.clip(wall[v : v + h, u : u + w].astype(int) + rng.integers(-60, 60), 0, 255)
        walls.append(wall)
    return walls


def at(wall, shift):
    """The picture of a wall so many pixels along it."""
    return np.ascontiguousarray(wall[:, shift : shift + WIDTH])


def changed(picture, how, rng):
    """The same place, seen otherwise."""
    if how == "shifted":
        return warped(picture, np.eye(2), np.array([9.0, -5.0]))
    if how == "turned and nearer":
        angle = np.radians(4)
        A = 1.06 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return warped(picture, A, np.array([-6.0, -14.0]))
    if how == "blurred":
        return cv2.blur(warped(picture, np.eye(2), np.array([6.0, 0.0])), (15, 1))
    if how == "out of focus":
        return cv2.GaussianBlur(picture, (0, 0), 4.0)
    if how == "brighter":
        return cv2.convertScaleAbs(picture, alpha=1.3, beta=25)
    if how == "darker":
        return cv2.convertScaleAbs(picture, alpha=0.25)
    if how == "noisy":
        return np.clip(picture + 20.0 * rng.standard_normal(picture.shape), 0, 255).astype(np.uint8)
    if how == "partly hidden":
        return np.where(np.arange(WIDTH) < 0.2 * WIDTH, 150, picture).astype(np.uint8)
    if how == "rolled":
        angle = np.radians(50)
        A = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        centre = 0.5 * np.array([WIDTH - 1, HEIGHT - 1])
        return warped(picture, A, centre - A @ centre)
    raise AssertionError(how)


HOWS = ("shifted", "turned and nearer", "blurred", "out of focus", "brighter", "darker", "noisy", "partly hidden", "rolled")


# --- one step --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", HOWS)
def test_the_same_place_seen_otherwise_continues(scenes, rng, how):
    a = at(scenes[0], 40)
    assert followed([a, changed(a, how, rng)]) == [None, 0]
    assert followed([changed(a, how, rng), a]) == [None, 0]


@pytest.mark.parametrize("how", HOWS)
def test_another_place_does_not(scenes, rng, how):
    a, other = at(scenes[0], 40), changed(at(scenes[1], 40), how, rng)
    assert followed([a, other]) == [None, None]
    mirrored = cv2.flip(a, 1)
    assert followed([a, mirrored, changed(mirrored, how, rng)]) == [None, None, 1]


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_what_shows_nothing_neither_continues_nor_is_continued(scenes, rng, grey):
    a, plain = at(scenes[0], 40), np.full_like(BLACK, grey)
    dim = np.clip(plain + 2.0 * rng.standard_normal(plain.shape), 0, 255).astype(np.uint8)
    for nothing in (plain, dim):
        assert followed([a, nothing, nothing]) == [None, None, None]
        assert followed([nothing, a, a]) == [None, None, 1]


def test_the_flow_is_from_the_picture_followed(scenes):
    found = tracker()
    for index, shift in enumerate((0, 4, 10)):
        flow, follows = found.follow(index, at(scenes[0], shift))
        if index:
            assert follows == index - 1 and flow.shape == (HEIGHT, WIDTH, 2) and flow.dtype == np.float32
            expected = [-4.0 if index == 1 else -6.0, 0.0]
            np.testing.assert_allclose(np.median(flow[20:-20, 20:-20], axis=(0, 1)), expected, atol=0.1)
    found.follow(3, at(scenes[1], 0))
    flow, follows = found.follow(4, at(scenes[0], 13))
    assert follows == 2
    np.testing.assert_allclose(np.median(flow[20:-20, 20:-20], axis=(0, 1)), [-3.0, 0.0], atol=0.1)


@pytest.mark.parametrize("wall", [0, 1, 2])
@pytest.mark.parametrize("shift", [WIDTH // 3, -WIDTH // 3])
def test_a_third_of_a_picture_is_found_by_the_homography(scenes, wall, shift):
    a, b = at(scenes[wall], 200), at(scenes[wall], 200 + shift)
    flow, follows = (found := tracker()).follow(0, a) and found.follow(1, b)
    assert follows == 0
    seen = flow[20:-20, shift + 20 : -20] if shift > 0 else flow[20:-20, 20 : shift - 20]
    np.testing.assert_allclose(np.median(seen, axis=(0, 1)), [-shift, 0.0], atol=0.3)
    assert (np.abs(seen - [-shift, 0.0]).max(axis=2) < 1.0).mean() > 0.8
    assert followed([a, b], min_matches=10**6) == [None, None]  # the flow alone does not get there


# --- breaks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stray", ["another place", "black", "noise"])
def test_after_a_stray_picture_the_next_one_follows_the_one_before_it(scenes, rng, stray):
    strays = {"another place": at(scenes[1], 0), "black": BLACK, "noise": rng.integers(0, 256, BLACK.shape, np.uint8)}
    a = [at(scenes[0], 3 * k) for k in range(6)]
    assert followed([*a[:3], strays[stray], *a[3:]]) == [None, 0, 1, None, 2, 4, 5]
    assert followed([*a[:3], strays[stray], a[3], strays[stray], *a[4:]]) == [None, 0, 1, None, 2, None, 4, 6]


def test_a_place_is_remembered_over_several_strays_that_differ(scenes, rng):
    a = [at(scenes[0], 3 * k) for k in range(5)]
    strays = [at(scenes[1], 0), BLACK, at(scenes[2], 0), rng.integers(0, 256, BLACK.shape, np.uint8)]
    assert followed([*a[:3], *strays, *a[3:]]) == [None, 0, 1, None, None, None, None, 2, 7]


def test_after_a_cut_the_pictures_of_the_new_place_follow_each_other_and_a_cut_back_goes_on(scenes):
    a, b = ([at(wall, 3 * k) for k in range(8)] for wall in scenes[:2])
    assert followed([*a[:4], *b]) == [None, 0, 1, 2, None, 4, 5, 6, 7, 8, 9, 10]
    assert followed([*a[:4], *b[:4], *a[4:]]) == [None, 0, 1, 2, None, 4, 5, 6, 3, 8, 9, 10]


def test_a_film_that_begins_black_remembers_its_first_place(scenes):
    a = [at(scenes[0], 3 * k) for k in range(5)]
    assert followed([BLACK, BLACK, *a[:3], at(scenes[1], 0), *a[3:]]) == [None, None, None, 2, 3, None, 4, 6]


@pytest.mark.parametrize("between", ["black", "another place"])
def test_a_place_is_given_up_after_a_while(scenes, between):
    a, other = at(scenes[0], 0), BLACK if between == "black" else at(scenes[1], 0)
    for length, follows in ((5, 1), (9, 1), (12, None)):
        pictures = [a, a, *[other] * length, a, a]
        assert followed(pictures, max_gap=10)[-2:] == [follows, length + 2], length


def test_indices_count_and_not_pictures(scenes):
    a, other = at(scenes[0], 0), at(scenes[1], 0)
    assert followed([(7, a), (20, a), (21, other), (25, a)]) == [None, 7, None, 20]
    assert followed([(7, a), (20, a), (21, other), (40, other), (41, a)], max_gap=10) == [None, 7, None, 21, None]


def test_where_it_is_disabled_each_picture_follows_the_one_before(scenes):
    pictures = [at(scenes[0], 0), at(scenes[1], 0), BLACK, at(scenes[0], 3)]
    assert followed(pictures, enabled=False) == [None, 0, 1, 2]
    found = tracker(enabled=False)
    assert [found.follow(k, picture)[0] is None for k, picture in enumerate(pictures)] == [True, False, False, False]


def test_the_same_pictures_give_the_same_flows(scenes, rng):
    pictures = [at(scenes[0], 0), at(scenes[0], 100), changed(at(scenes[0], 104), "noisy", rng), at(scenes[1], 0), at(scenes[0], 106)]

    def flows():
        found = tracker()
        return [b"" if flow is None else flow.tobytes() for flow, _ in (found.follow(k, p) for k, p in enumerate(pictures))]

    first = flows()
    assert first == flows() and [len(flow) > 0 for flow in first] == [False, True, True, False, True]


def test_the_demo_goes_on_from_frame_to_frame(demo):
    pictures = [cv2.resize(demo.read(k).image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for k in range(0, 60, 2)]
    assert followed(pictures) == [None, *range(29)]


# --- the parts -------------------------------------------------------------------------------------------------------


def test_the_grid_is_the_mean_of_blocks(rng):
    picture = rng.integers(0, 256, (40, 60), np.uint8)
    view = view_of(3, picture, CONFIG)
    np.testing.assert_allclose(view.grid, picture.reshape(10, 4, 15, 4).mean(axis=(1, 3)), atol=0.51)
    assert view.index == 3 and view.picture is picture and view.contrast == pytest.approx(view.grid.std())
    assert view_of(0, picture[:2, :3], CONFIG).grid.shape == (1, 1)


def test_correlation_is_the_obvious_one_where_the_flow_stays_inside(rng):
    a, b = rng.uniform(0, 255, (2, 12, 16)).astype(np.float32)
    flow = np.zeros((48, 64, 2), np.float32)
    assert correlation(a, b, flow) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1], abs=1e-5)
    assert correlation(a, 255 - 0.5 * a, flow) == pytest.approx(-1.0, abs=1e-5)
    flow[:] = [12.0, -8.0]  # three cells to the right, two up
    moved = np.full_like(a, 100.0)
    moved[:-2, 3:] = a[2:, :-3]
    assert correlation(a, moved, flow) == pytest.approx(1.0, abs=1e-5)
    flow[:] = [60.0, 0.0]
    assert correlation(a, a, flow) == 0.0  # next to nothing of it is left


def test_the_homography_is_that_of_the_corners(scenes):
    a, H = at(scenes[0], 100), np.array([[1.05, 0.03, -30.0], [-0.02, 0.98, 12.0], [1e-4, -5e-5, 1.0]])
    b = cv2.warpPerspective(a, H, (WIDTH, HEIGHT))
    a, b, black, other = (view_of(k, picture, CONFIG) for k, picture in enumerate((a, b, BLACK, at(scenes[1], 100))))
    flow = homography_flow(a, b, CONFIG)
    u, v = np.meshgrid(np.arange(40.0, WIDTH - 40), np.arange(40.0, HEIGHT - 40))
    x = np.stack([u, v, np.ones_like(u)], axis=-1) @ H.T
    np.testing.assert_allclose(flow[40:-40, 40:-40], x[..., :2] / x[..., 2:] - np.stack([u, v], axis=-1), atol=1.5)
    assert homography_flow(a, black, CONFIG) is None and homography_flow(black, a, CONFIG) is None
    assert homography_flow(a, other, CONFIG) is None


# --- which of two flows is the better one ------------------------------------------------------------------------------


def test_the_step_is_in_sizes_of_the_picture():
    flow = np.zeros((100, 400, 2), np.float32)
    flow[..., 0], flow[..., 1] = 6.0, 8.0
    assert step_of(flow) == pytest.approx(10.0 / 200.0)
    assert step_of(np.repeat(np.repeat(flow, 2, axis=0), 2, axis=1) * 2) == pytest.approx(step_of(flow))  # at any resolution


def test_the_residual_is_the_mean_difference_of_what_both_pictures_show(rng):
    a, b = (rng.integers(0, 256, (12, 16)).astype(np.uint8) for _ in range(2))
    flow = np.zeros((12, 16, 2), np.float32)
    flow[..., 0], flow[..., 1] = 3.0, -2.0
    pairs = [(a[v, u], b[v - 2, u + 3]) for v in range(2, 12) for u in range(13)]
    assert residual(a, b, flow) == pytest.approx(np.mean([min(20, abs(int(x) - int(y))) for x, y in pairs]))
    assert residual(a, a, np.zeros_like(flow)) == 0.0
    assert residual(a, b, flow + 15.0) == np.inf  # nothing is in both


@pytest.mark.parametrize("shift", [0.0, 0.01, 0.05])
def test_corners_are_asked_where_the_step_is_large(scenes, shift, monkeypatch):
    from vitamin3d.tracking import continuity

    asked = []
    monkeypatch.setattr(continuity, "homography_flow", lambda a, b, config: asked.append(shift) or homography_flow(a, b, config))
    by = round(shift * np.sqrt(WIDTH * HEIGHT))
    first, second = at(scenes[0], 0), at(scenes[0], by)
    assert followed([first, second]) == [None, 0]
    assert bool(asked) == (shift > CONFIG.large_step)


def test_where_the_exposure_changed_too_the_flow_that_looks_alike_is_taken(scenes):
    """A flow that finds the place and one that does not differ little in grey levels then."""
    first, second = at(scenes[0], 0), (0.55 * at(scenes[0], 110) + 30).astype(np.uint8)
    flows = tracker()
    assert followed([first, second], flows)[1] == 0
    flow = tracker()
    flow.follow(0, first)
    found = flow.follow(1, second)[0]
    assert np.median(np.abs(found[20:-20, 130:-20] - (-110.0, 0.0))) < 1.5


def test_a_leap_that_no_corners_confirm_is_no_continuation(scenes):
    """After a covered lens any flow may look a little like the next picture."""
    first, second = at(scenes[0], 0), at(scenes[0], 60)
    assert 60 / np.sqrt(WIDTH * HEIGHT) > CONFIG.largest_step
    assert followed([first, second]) == [None, 0]
    assert followed([first, second], min_matches=10_000) == [None, None]
