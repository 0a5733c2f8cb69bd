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
    print("LAST", last, beginning.map.frame_indices, len(beginning.map.landmarks))
    assert last >= 1 and initializer.reason == "" and initializer.num_retries == 0
    assert beginning.map.frame_indices == [frame.index for frame in beginning.keyframes] and beginning.map.frame_indices[-1] == last
    assert [frame.index for frame, _ in beginning.placed] == list(range(last + 1)) and beginning.turned == []
    np.testing.assert_array_equal(beginning.map.T_cam_world[0], np.eye(4))
    check_poses(beginning.placed, poses, scale_of(beginning))
