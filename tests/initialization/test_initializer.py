# SPDX-License-Identifier: Apache-2.0
"""The frames before there is a map, and the map that two of them make."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_poses, project, rotation_error_deg, view_of

from vitamin3d.config import Config
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.initialization.initializer import Initializer
from vitamin3d.types import DominantFlow, FrontEndFrame, SlamState, Tracks

NUM_TRACKS = 400
POINTS = np.random.default_rng(5).uniform([-2.2, -1.6, 4.0], [2.2, 1.6, 8.0], (NUM_TRACKS, 3))


class KnownTracks:
    """A tracker whose newest view is told to it."""

    def __init__(self, first_id=0):
        self.first_id, self.newest = first_id, view_of(0, [])

    def seen(self):
        return self.newest.tracks, self.newest.ideal_pixels

    def view(self, frame):
        assert frame is self.newest.frame
        return self.newest


def show(index, T, rng, first_id=0, sigma_px=0.3):
    """A view of the points from T, by tracks of some age."""
    pixels = project(PINHOLE, T, POINTS) + sigma_px * rng.standard_normal((NUM_TRACKS, 2))
    view, ids = view_of(index, first_id + np.arange(NUM_TRACKS), pixels), first_id + np.arange(NUM_TRACKS)
    tracks = Tracks(ids, pixels, view.tracks.kappa, np.full(NUM_TRACKS, 9, np.int32), view.tracks.missed)
    return dataclasses.replace(view, tracks=tracks)


def tell(initializer, view, follows="the one before"):
    """The newest frame is this view; what became of it."""
    index, no_flow = view.frame.index, DominantFlow(np.eye(2), np.zeros(2), 0.0)
    follows = index - 1 if follows == "the one before" else follows
    initializer.tracker.newest = view
    nothing = np.zeros((1, 1), np.float32), np.zeros((0, 2), np.int32)
    return initializer.try_frame(FrontEndFrame(view.frame, *nothing, no_flow, None, follows), PINHOLE)


def film(rng, count=10, first_id=0):
    """A camera on an arc."""
    poses = arc_poses(count)
    return poses, [show(k, T, rng, first_id) for k, T in enumerate(poses)]


def begin(initializer, views):
    """Tells it all views up to the one with which there is a map: the number of that, and the map."""
    for k, view in enumerate(views):
        beginning = tell(initializer, view, "the one before" if k else None)
        if beginning is not None:
            return k, beginning
    raise AssertionError(initializer.reason)


def scale_of(beginning):
    """Map units per unit of the scene."""
    rows = beginning.map.landmarks
    return np.median(beginning.map.points_world[rows, 2]) / np.median(POINTS[beginning.map.ids_of(rows) % NUM_TRACKS, 2])


def check_poses(found, poses, scale, atol=0.05):
    """Of (frame, T_cam_world): those of the film."""
    for frame, T in found:
        assert rotation_error_deg(T, poses[frame.index]) < 0.3
        np.testing.assert_allclose(inverse(T)[:3, 3] / scale, inverse(poses[frame.index])[:3, 3], atol=atol)


# --- a map -----------------------------------------------------------------------------------------------------------


def test_two_frames_with_parallax_make_a_map_in_which_all_others_have_their_place(rng):
    initializer, (poses, views) = Initializer(KnownTracks(), Config()), film(rng)
    assert initializer.reason and initializer.state is SlamState.INITIALIZING
    last, beginning = begin(initializer, views)
    assert last >= 1 and initializer.reason == "" and initializer.num_retries == 0
    assert beginning.map.frame_indices == [frame.index for frame in beginning.keyframes] and beginning.map.frame_indices[-1] == last
    assert [frame.index for frame, _ in beginning.placed] == list(range(last + 1)) and beginning.turned == []
    np.testing.assert_array_equal(beginning.map.T_cam_world[0], np.eye(4))
    check_poses(beginning.placed, poses, scale_of(beginning))


def test_the_map_has_the_ids_of_the_tracks(rng):
    initializer = Initializer(KnownTracks(1000), Config())
    _, beginning = begin(initializer, film(rng, first_id=1000)[1])
    assert set(beginning.map.ids_of(beginning.map.landmarks)) <= set(range(1000, 1000 + NUM_TRACKS))
    assert (beginning.map.rows_of(np.arange(1000)) == -1).all() and len(beginning.map.points_world) <= NUM_TRACKS


def test_frames_that_are_there_already_make_a_map_at_once(rng):
    poses, views = film(rng, 6)
    initializer = Initializer(KnownTracks(), Config())
    beginning = initializer.try_views(views, PINHOLE)
    assert beginning.map.frame_indices[0] == 0 and beginning.map.frame_indices[-1] == 5
    check_poses(beginning.placed, poses, scale_of(beginning))
    for few in ([], views[:1], [views[0]] * 4):
        initializer = Initializer(KnownTracks(), Config())
        if few:
            assert initializer.try_views(few, PINHOLE) is None and initializer.reason


# --- none yet --------------------------------------------------------------------------------------------------------


def test_it_says_why_there_is_no_map_yet(rng):
    still = Initializer(KnownTracks(), Config())
    for k in range(5):
        assert tell(still, show(k, np.eye(4), rng)) is None
    assert still.reason.startswith("no parallax") and still.num_retries == 0
    few = Initializer(KnownTracks(), Config())
    for k in range(5):
        assert tell(few, view_of(k, range(20))) is None
    assert few.reason.startswith("too few features: 20 tracks")


def test_tracks_that_agree_on_no_motion_make_no_map(rng):
    initializer = Initializer(KnownTracks(), Config())
    for k in range(3):
        assert tell(initializer, view_of(k, np.arange(NUM_TRACKS), rng.uniform(0, 480, (NUM_TRACKS, 2)))) is None
    assert initializer.num_retries > 0 and "the motion" in initializer.reason


# --- pictures of something else --------------------------------------------------------------------------------------


def test_a_stray_picture_is_left_out(rng):
    initializer, (poses, views) = Initializer(KnownTracks(), Config()), film(rng)
    stray = view_of(2, 9000 + np.arange(300), rng.uniform(0, 480, (300, 2)))
    assert tell(initializer, views[0], None) is tell(initializer, views[1]) is tell(initializer, stray, None) is None
    beginning = tell(initializer, views[3], 1)
    assert beginning.map.frame_indices[0] == 0 and [frame.index for frame, _ in beginning.placed] == [0, 1, 3]
    check_poses(beginning.placed, poses, scale_of(beginning))


def test_after_a_cut_the_map_begins_with_the_first_picture_after_it(rng):
    initializer, (poses, after) = Initializer(KnownTracks(), Config()), film(rng, first_id=5000)
    for k in range(2):
        tell(initializer, view_of(k, np.arange(300), rng.uniform(0, 480, (300, 2))), k - 1 if k else None)
    assert tell(initializer, after[2], None) is None
    _, beginning = begin_after(initializer, after[3:])
    assert beginning.map.frame_indices[0] == beginning.placed[0][0].index == 2
    placed = [(frame, T @ poses[2]) for frame, T in beginning.placed]
    assert all(rotation_error_deg(T, poses[frame.index]) < 0.5 for frame, T in placed)


def begin_after(initializer, views):
    """As `begin`; the first view continues the newest one."""
    for k, view in enumerate(views):
        beginning = tell(initializer, view)
        if beginning is not None:
            return k, beginning
    raise AssertionError(initializer.reason)


# --- a camera that only turns ----------------------------------------------------------------------------------------


def turn(degrees):
    return exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.radians(degrees), 0.0]))


def test_a_camera_that_turns_is_said_to_turn_and_makes_no_map(rng):
    initializer, states = Initializer(KnownTracks(), Config()), []
    for k in range(10):
        assert tell(initializer, show(k, turn(1.2 * k), rng), k - 1 if k else None) is None
        states.append(initializer.state)
    assert states == [SlamState.INITIALIZING] * 5 + [SlamState.ROTATING] * 5 and "turns but does not travel" in initializer.reason


@pytest.mark.slow
def test_the_frames_of_a_turn_lie_where_the_map_begins(rng):
    """Points all around; the camera turns on, and after a while it travels."""
    rays = rng.standard_normal((9000, 3))
    points = rays / np.linalg.norm(rays, axis=1, keepdims=True) * rng.uniform(3, 10, (9000, 1))
    initializer, born, views, poses = Initializer(KnownTracks(), Config()), np.full(9000, -1), [], []
    for k in range(80):
        T = turn(1.5 * k)
        T[0, 3] = 0.012 * max(0, k - 40)
        pixels = project(PINHOLE, T, points) + 0.3 * rng.standard_normal((9000, 2))
        ids = np.flatnonzero(((points @ T[:3, :3].T + T[:3, 3])[:, 2] > 0.5) & PINHOLE.is_inside(pixels))
        born[ids[born[ids] < 0]] = k
        views.append(view_of(k, ids, pixels[ids]))
        views[-1].tracks.ages[:] = k - born[ids]
        poses.append(T)
    last, beginning = begin(initializer, views)
    first = beginning.map.frame_indices[0]
    assert 10 < first < last - 10 and [frame.index for frame, _ in beginning.turned][: first + 1] == list(range(first + 1))
    for frame, T in beginning.turned[: first + 1]:
        np.testing.assert_array_equal(T[:3, 3], 0.0)
        assert rotation_error_deg(T, poses[frame.index] @ inverse(poses[first])) < 0.5
        assert frame.image.size == 0
