# SPDX-License-Identifier: Apache-2.0
"""The live tracks of a film of round hills that move together."""

import dataclasses

import numpy as np
import pytest
import reference
from scenes import EUROC, PINHOLE, texture, view_of, warped

from vitamin3d.config import Config, ContinuityConfig, ExtremaConfig
from vitamin3d.geometry.rolling_shutter import NO_MOTION, ideal_pixels
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.tracking.tracker import Tracker, TrackIds
from vitamin3d.types import DominantFlow, Frame, FrontEndFrame, Tracks

CAMERA = dataclasses.replace(PINHOLE, fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
HILLS = np.array([(u, v) for v in range(25, 100, 12) for u in range(20, 135, 12)])
STEP = np.array([3, -2])
PERIOD_NS = 50_000_000
VELOCITY = STEP / (1e-9 * PERIOD_NS)
"""Pixels per second."""
LAST_MISSED = Config().extrema_tracking.coast_frames


def film(index, follows="the one before", hills=HILLS, since=None, moved=STEP):
    """Picture `index` of the film, in which the hills have moved by STEP each time, or by `moved` in all since the one it follows."""
    centres = hills + index * STEP
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    kappa = np.zeros(u.shape, np.float32)
    for x, y in centres:
        kappa += np.maximum(0.0, 1.0 - ((u - x) ** 2 + (v - y) ** 2) / 16.0).astype(np.float32)
    follows = index - 1 if follows == "the one before" else follows
    half = np.broadcast_to(np.float32(0.5) * moved.astype(np.float32), (CAMERA.height // 2, CAMERA.width // 2, 2))
    frame = Frame(index, index * PERIOD_NS, np.zeros((CAMERA.height, CAMERA.width), np.uint8))
    flow = None if follows is None else np.ascontiguousarray(half)
    return FrontEndFrame(frame, kappa, centres.astype(np.int32), DominantFlow(np.eye(2), np.zeros(2), 0.0), flow, follows)


def process(tracker, front, measures_motion=False, refills=True):
    result = tracker.follow(front, measures_motion)
    if refills:
        tracker.refill(front)
    tracker.end_frame(front.frame)
    return result


def begun(camera=CAMERA, config=None, ids=None, measures_motion=False):
    """After the first picture."""
    tracker = Tracker(camera, config or Config(), ids)
    process(tracker, film(0, None), measures_motion)
    return tracker


def some_tracks(pixels, missed=0):
    n = len(pixels)
    return Tracks(
        np.arange(n), np.array(pixels, float), np.ones(n, np.float32), np.zeros(n, np.int32), np.broadcast_to(np.int32(missed), n)
    )


# --- ids -------------------------------------------------------------------------------------------------------------


def test_each_id_is_given_once(rng):
    ids = TrackIds()
    taken = [ids.take(int(count)) for count in rng.integers(0, 50, 40)]
    np.testing.assert_array_equal(np.concatenate(taken), np.arange(ids.next))


def test_two_trackers_that_share_their_ids_never_have_the_same():
    ids = TrackIds()
    one = begun(ids=ids)
    other = begun(ids=ids)
    for index in (1, 2):
        process(one, film(index))
        process(other, film(index, None))  # all of its tracks end, new ones are born
    assert one.first_id == 0 and other.first_id == len(HILLS) == len(one.tracks) == len(other.tracks)
    assert not set(one.tracks.ids) & set(other.tracks.ids) and min(other.tracks.ids) >= 3 * len(HILLS)
    assert one.num_born == len(HILLS) and other.num_born == 3 * len(HILLS)


def test_a_tracker_of_its_own_begins_with_nothing():
    tracker = Tracker(CAMERA, Config())
    assert (len(tracker.tracks), tracker.newest_frame, tracker.frame_count, tracker.num_born, tracker.first_id) == (0, -1, 0, 0, 0)
    seen, pixels = tracker.seen()
    assert len(seen) == 0 and pixels.shape == (0, 2)


# --- from frame to frame ---------------------------------------------------------------------------------------------


def test_extrema_become_tracks_that_go_on():
    tracker = begun()
    assert (tracker.tracks.ages == 0).all() and (tracker.tracks.missed == 0).all()
    first = dict(zip(tracker.tracks.ids.tolist(), tracker.tracks.pixels, strict=True))
    assert sorted(map(tuple, first.values())) == sorted(map(tuple, HILLS))
    for index in (1, 2, 3):
        process(tracker, film(index))
    assert tracker.frame_count == 4 and tracker.newest_frame == 3 and (tracker.tracks.ages == 3).all()
    assert set(tracker.tracks.ids) == set(first)
    for id_, pixel in zip(tracker.tracks.ids, tracker.tracks.pixels, strict=True):
        np.testing.assert_allclose(pixel, first[id_] + 3 * STEP, atol=1e-3)


def test_only_what_is_free_becomes_a_track():
    tracker = begun()
    tracker.refill(film(0, None))
    assert len(tracker.tracks) == tracker.num_born == len(HILLS)
    tracker.end(tracker.tracks.ids[:5])
    tracker.refill(film(0, None))
    assert len(tracker.tracks) == len(HILLS) and sorted(tracker.tracks.ids)[-5:] == list(range(len(HILLS), len(HILLS) + 5))


def test_new_tracks_are_wanted_every_few_frames():
    tracker = Tracker(CAMERA, dataclasses.replace(Config(), extrema=ExtremaConfig(refill_interval=3)))
    due = []
    for index in range(7):
        due.append(tracker.is_refill_due)
        process(tracker, film(index, None), refills=False)
    assert due == [True, False, False, True, False, False, True]


def test_a_track_whose_extremum_is_gone_coasts_for_a_while_and_ends():
    tracker, gone = begun(), 17
    (id_,) = tracker.tracks.ids[(tracker.tracks.pixels == HILLS[gone]).all(axis=1)]
    for index in range(1, LAST_MISSED + 1):
        process(tracker, film(index, hills=np.delete(HILLS, gone, axis=0)), refills=False)
        (row,) = np.flatnonzero(tracker.tracks.ids == id_)
        assert tracker.tracks.missed[row] == index and id_ not in tracker.seen()[0].ids
        np.testing.assert_allclose(tracker.tracks.pixels[row], HILLS[gone] + index * STEP, atol=1e-3)
    process(tracker, film(LAST_MISSED + 1, hills=np.delete(HILLS, gone, axis=0)), refills=False)
    assert id_ not in tracker.tracks.ids and len(tracker.tracks) == len(HILLS) - 1


def test_without_a_dense_flow_the_dominant_one_predicts():
    front = film(1)
    tracker, dominant = begun(), dataclasses.replace(front, dense_flow=None, dominant_flow=DominantFlow(np.eye(2), STEP.astype(float), 1.0))
    process(tracker, dominant, refills=False)
    assert len(tracker.tracks) == len(HILLS) and (tracker.tracks.missed == 0).all()


def test_tracks_end_where_the_map_says_so():
    tracker = begun()
    before = tracker.tracks
    tracker.end(np.zeros(0, np.int64))
    assert tracker.tracks is before
    tracker.end(np.array([before.ids[3], before.ids[8], 10**6]))
    np.testing.assert_array_equal(tracker.tracks.ids, np.delete(before.ids, [3, 8]))
    np.testing.assert_array_equal(tracker.tracks.pixels, np.delete(before.pixels, [3, 8], axis=0))
    tracker.end_all()
    assert len(tracker.tracks) == len(tracker.seen()[0]) == 0 and len(before) == len(HILLS)


def test_tracks_that_are_taken_up_go_on_like_all_others():
    tracker = begun()
    came_back = Tracks.concatenate(
        tracker.tracks.select(slice(4, None)), dataclasses.replace(tracker.tracks.select(slice(2)), ids=[901, 900])
    )
    tracker.take_up(came_back)
    process(tracker, film(1), refills=False)
    assert set(tracker.tracks.ids) == {*range(4, len(HILLS)), 900, 901} and set(tracker.seen()[0].ids) == set(tracker.tracks.ids)


# --- what is seen ----------------------------------------------------------------------------------------------------


def test_seen_tracks_have_ideal_pixels(rng):
    tracker, pixels = Tracker(EUROC, Config()), rng.uniform([20, 20], [730, 460], (40, 2))
    tracker.take_up(some_tracks(pixels))
    seen, ideal = tracker.seen()
    np.testing.assert_array_equal(seen.pixels, pixels)
    focal, middle = np.array([EUROC.fx, EUROC.fy]), np.array([EUROC.cx, EUROC.cy])
    expected = [focal * reference.undistort((p - middle) / focal, EUROC.distortion) + middle for p in pixels]
    np.testing.assert_allclose(ideal, expected, atol=1e-6)


def test_tracks_that_coast_or_that_the_lens_does_not_show_are_not_seen():
    tracker = Tracker(EUROC, Config())
    tracker.take_up(some_tracks([[300, 200], [400, 200], [1e5, 1e5], [300, 100]], missed=[0, 1, 0, 0]))
    seen, ideal = tracker.seen()
    np.testing.assert_array_equal(seen.ids, [0, 3])
    assert ideal.shape == (2, 2) and np.isfinite(ideal).all()


def test_what_is_seen_is_computed_once_until_something_changes():
    tracker = begun(EUROC)
    before = tracker.seen()
    assert tracker.seen() is before
    tracker.use_camera(CAMERA)
    np.testing.assert_allclose(tracker.seen()[1], tracker.tracks.pixels)  # no distortion
    assert np.abs(before[1] - tracker.seen()[1]).max() > 1.0
    tracker.use_camera(EUROC)
    np.testing.assert_array_equal(tracker.seen()[1], before[1])
    tracker.end(tracker.tracks.ids[:1])
    assert len(tracker.seen()[0]) == len(tracker.seen()[1]) == len(HILLS) - 1
    process(tracker, film(1), refills=False)
    np.testing.assert_array_equal(tracker.seen()[0].pixels, tracker.tracks.pixels)


def test_a_view_is_the_frame_with_what_is_seen():
    rolling = dataclasses.replace(CAMERA, readout_s=0.02)
    tracker, front = begun(rolling, measures_motion=True), film(1)
    process(tracker, front, measures_motion=True, refills=False)
    view = tracker.view(front.frame)
    assert view.frame is front.frame and view.image_motion is tracker.image_motion
    np.testing.assert_array_equal(view.tracks.ids, tracker.seen()[0].ids)
    np.testing.assert_array_equal(view.ideal_pixels, tracker.seen()[1])


# --- how the image moves ---------------------------------------------------------------------------------------------


def test_the_motion_of_the_frame_before_is_the_mean_of_before_and_after_it():
    tracker = Tracker(CAMERA, Config())
    assert process(tracker, film(0, None), measures_motion=True) is None
    np.testing.assert_array_equal(tracker.image_motion, NO_MOTION)
    for index, share in ((1, 0.5), (2, 1.0), (3, 1.0)):  # before the first frame nothing moved, for all that is known
        timestamp_ns, motion = process(tracker, film(index), measures_motion=True)
        assert timestamp_ns == (index - 1) * PERIOD_NS
        np.testing.assert_allclose(motion[0], share * VELOCITY, rtol=1e-3)
        np.testing.assert_allclose(tracker.image_motion[0], VELOCITY, rtol=1e-3)
        np.testing.assert_allclose(tracker.image_motion[1:], 0.0, atol=0.1)


def test_where_nobody_wants_it_no_motion_is_measured():
    tracker = begun(measures_motion=True)
    process(tracker, film(1), measures_motion=True)
    assert process(tracker, film(2)) is None
    np.testing.assert_array_equal(tracker.image_motion, NO_MOTION)


def test_a_rolling_shutter_is_undone_by_the_motion():
    rolling = dataclasses.replace(CAMERA, readout_s=0.02)
    tracker = begun(rolling, measures_motion=True)
    process(tracker, film(1), measures_motion=True, refills=False)
    seen, ideal = tracker.seen()
    np.testing.assert_allclose(ideal, ideal_pixels(seen.pixels, tracker.image_motion, rolling))
    late = (seen.pixels[:, 1] + 0.5) / CAMERA.height - 0.5  # in readout times, after the middle row
    np.testing.assert_allclose(ideal, seen.pixels - 0.02 * late[:, None] * VELOCITY, atol=0.01)


# --- breaks ----------------------------------------------------------------------------------------------------------


def test_a_picture_that_continues_none_ends_all_tracks():
    tracker = begun(measures_motion=True)
    process(tracker, film(1), measures_motion=True)
    assert tracker.follow(film(2, None), True) is None
    assert len(tracker.tracks) == 0 and tracker.newest_frame == 1
    np.testing.assert_array_equal(tracker.image_motion, NO_MOTION)


def after_strays(max_gap, strays):
    """A tracker that has seen pictures 0 and 1, then so many strays, each with tracks of its own; and the ids before them."""
    tracker = begun(config=dataclasses.replace(Config(), continuity=ContinuityConfig(max_gap=max_gap)), measures_motion=True)
    process(tracker, film(1), measures_motion=True)
    ids = set(tracker.tracks.ids)
    for index in range(2, 2 + strays):
        process(tracker, film(index, None, HILLS[:65]), measures_motion=True)
    return tracker, ids


@pytest.mark.parametrize("strays", [1, 3])
def test_after_strays_the_tracks_from_before_them_go_on(strays):
    tracker, ids = after_strays(90, strays)
    assert not ids & set(tracker.tracks.ids)
    index = 2 + strays
    timestamp_ns, motion = process(tracker, film(index, 1, moved=(index - 1) * STEP), measures_motion=True, refills=False)
    assert set(tracker.tracks.ids) == ids and (tracker.tracks.ages == 2).all() and (tracker.tracks.missed == 0).all()
    assert timestamp_ns == PERIOD_NS  # of picture 1
    np.testing.assert_allclose(tracker.image_motion[0], VELOCITY, rtol=1e-3)  # over all the time since then
    np.testing.assert_allclose(motion[0], 0.5 * VELOCITY, rtol=1e-3)


def test_tracks_from_before_a_break_are_taken_up_once():
    tracker, ids = after_strays(90, 1)
    process(tracker, film(3, 1, moved=2 * STEP), refills=False)
    assert set(tracker.tracks.ids) == ids
    process(tracker, film(4, 1, moved=3 * STEP), refills=False)
    assert len(tracker.tracks) == 0


def test_a_picture_that_continues_the_stray_one_was_a_cut():
    tracker, ids = after_strays(90, 1)
    after_the_cut = set(tracker.tracks.ids)
    process(tracker, film(3, hills=HILLS[:65]), refills=False)
    assert set(tracker.tracks.ids) == after_the_cut and not ids & after_the_cut
    assert (tracker.tracks.ages == 1).all()


def test_the_first_break_is_remembered_until_it_is_too_long_ago():
    for max_gap, is_remembered in ((9, True), (1, False)):
        tracker, ids = after_strays(max_gap, 4)  # each of them a break
        process(tracker, film(6, 1, moved=5 * STEP), refills=False)
        assert (set(tracker.tracks.ids) == ids) == is_remembered and (len(tracker.tracks) == 0) != is_remembered


def test_of_breaks_that_are_too_long_ago_a_newer_one_is_remembered():
    tracker, _ = after_strays(1, 2)
    newer = set(tracker.tracks.ids)
    process(tracker, film(4, None, HILLS[:40]))  # breaks off from picture 3
    process(tracker, film(5, 3, moved=2 * STEP), refills=False)
    assert set(tracker.tracks.ids) == newer


def test_the_break_that_is_remembered_is_the_front_ends():
    """Three pictures of something else each; the fourth is the second, moved."""
    config = dataclasses.replace(Config(), continuity=ContinuityConfig(max_gap=1))
    front_end, tracker, ids = FrontEnd(config), Tracker(CAMERA, config), []
    pictures = [texture(240, 320, np.random.default_rng(seed), 4.0) for seed in (1, 2, 3)]
    for index, picture in enumerate([*pictures, warped(pictures[1], np.eye(2), np.array([2.0, 0.0]))]):
        front = front_end.process(Frame(index, index * PERIOD_NS, picture))
        process(tracker, front)
        ids.append(set(tracker.tracks.ids))
    assert (front.follows == 1) == (len(ids[1] & ids[3]) > 100)


def test_a_picture_without_tracks_is_nothing_to_come_back_to():
    tracker, ids = after_strays(90, 0)
    for index in (2, 3):
        process(tracker, film(index, None, HILLS[:0]))  # black
    process(tracker, film(4, 1, moved=3 * STEP), refills=False)
    assert set(tracker.tracks.ids) == ids


def test_where_there_were_no_tracks_a_later_break_is_remembered():
    tracker = Tracker(CAMERA, Config())
    process(tracker, film(0, None, HILLS[:0]))  # black
    process(tracker, film(1, None))
    process(tracker, film(2))
    ids = set(tracker.tracks.ids)
    process(tracker, film(3, None, HILLS[:65]))
    process(tracker, film(4, 2, moved=2 * STEP), refills=False)
    assert set(tracker.tracks.ids) == ids


def test_a_picture_that_repeats_the_one_before_is_continued_like_it():
    tracker = begun()
    before = tracker.tracks
    tracker.pass_over(Frame(1, PERIOD_NS, np.zeros((CAMERA.height, CAMERA.width), np.uint8)))
    assert tracker.tracks is before and tracker.newest_frame == 1 and tracker.frame_count == 1
    process(tracker, film(2, 1, moved=2 * STEP), refills=False)
    np.testing.assert_array_equal(np.sort(tracker.tracks.ids), np.sort(before.ids))
    assert (tracker.tracks.ages == 1).all()


# --- another tracker's tracks ----------------------------------------------------------------------------------------


def test_another_trackers_tracks_go_on_under_their_ids():
    ids = TrackIds()
    one = begun(ids=ids, measures_motion=True)
    views = [one.view(film(0, None).frame)]
    process(one, film(1), measures_motion=True)
    views.append(one.view(film(1).frame))
    other = Tracker(CAMERA, Config(), ids)
    assert other.first_id == len(HILLS)
    other.continue_from(views)
    assert other.first_id == 0 and other.newest_frame == 1 and other.image_motion is views[1].image_motion
    timestamp_ns, motion = process(other, film(2), measures_motion=True)
    assert set(one.tracks.ids) == set(other.tracks.ids) and (other.tracks.ages == 2).all()
    assert timestamp_ns == PERIOD_NS
    np.testing.assert_allclose(motion[0], VELOCITY, rtol=1e-3)


def test_the_least_id_is_that_of_all_views_that_come_along():
    ids = TrackIds()
    ids.take(100)
    tracker = Tracker(CAMERA, Config(), ids)
    tracker.continue_from([view_of(5, [40, 30]), view_of(6, [50, 41]), view_of(7, [])])
    assert tracker.first_id == 30 and tracker.newest_frame == 7 and len(tracker.tracks) == 0
