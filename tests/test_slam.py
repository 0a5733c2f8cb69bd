# SPDX-License-Identifier: Apache-2.0
"""Frames that say nothing themselves are placed by those around them: repeated pictures, and the frames of a turn."""

import numpy as np
import pytest
from scenes import PINHOLE

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame, SlamState

PERIOD_NS = 50_000_000


def film(demo, shown):
    """An atlas of a film in which frame n shows the demo's picture shown[n]."""
    front_end, atlas = FrontEnd(Config()), Atlas(demo.camera, Config())
    for index, source in enumerate(shown):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, demo.read(source).image)))
    return atlas


# --- repeated pictures -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_repeated_pictures_lie_on_the_way_to_the_next_one(demo):
    shown = [*range(60), 59, 59, 59, *range(63, 90)]
    slam, plain = film(demo, shown).ranked()[0], film(demo, range(90)).ranked()[0]
    assert all(index in slam.poses for index in range(90))
    centres, truth = ([inverse(s.poses.pose(k, s.map))[:3, 3] for k in range(57, 67)] for s in (slam, plain))
    step = np.linalg.norm(np.diff(truth, axis=0), axis=1).mean()
    assert step > 1e-3  # the camera moves on meanwhile
    assert np.linalg.norm(np.array(centres) - truth, axis=1).max() < 0.5 * step
    assert not any(frame in slam.map.frame_indices for frame in (60, 61, 62))


@pytest.mark.slow
def test_a_film_that_ends_with_repeated_pictures_ends_there(demo):
    atlas = film(demo, [*range(60), 59, 59])
    slam = atlas.ranked()[0]
    assert 60 not in slam.poses
    atlas.finish()
    a, b = (slam.poses.pose(k, slam.map) for k in (59, 61))
    np.testing.assert_allclose(a, b, atol=1e-12)


# --- turns -------------------------------------------------------------------------------------------------------


@pytest.fixture
def turning():
    """A map of one keyframe, and three frames of a turn after it, all where the keyframe is; landmarks at depth 2."""
    slam, empty = Slam(PINHOLE, Config()), np.zeros(0, np.int64)
    slam.map.add_keyframe(0, 0, np.eye(4), empty, np.zeros((0, 2)), np.zeros((0, 3), np.uint8), np.zeros((0, 81), np.uint8))
    slam.poses.add(Frame(0, 0, np.zeros((1, 1), np.uint8)), 0, np.eye(4))
    for k in (1, 2, 3):
        slam.poses.add_world(Frame(k, k * PERIOD_NS, np.zeros((1, 1), np.uint8)), exp_se3(np.array([0, 0, 0, 0, 0.1 * k, 0])), slam.map)
        slam.localizer._turned_frames.append(k)
    slam.localizer.state = SlamState.ROTATING
    return slam


def seen_from(centre):
    """T_cam_world of a camera there, and landmarks at depth 2 before it."""
    T = np.eye(4)
    T[:3, 3] = -np.array(centre)
    return T, np.array(centre) + np.array([[0.1, 0.0, 2.0], [-0.1, 0.2, 2.0], [0.0, -0.1, 2.0]])


def test_after_a_turn_its_frames_are_on_the_way(turning):
    rotations = [turning.poses.pose(k, turning.map)[:3, :3] for k in (1, 2, 3)]
    turning.localizer._end_turn(*seen_from([0.04, 0.0, 0.0]))
    for k in (1, 2, 3):
        T = turning.poses.pose(k, turning.map)
        np.testing.assert_allclose(inverse(T)[:3, 3], [0.01 * k, 0.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(T[:3, :3], rotations[k - 1], atol=1e-12)
    assert not turning.localizer._turned_frames


def test_a_turn_that_ends_far_away_was_none(turning):
    turning.localizer._end_turn(*seen_from([1.0, 0.0, 0.0]))
    assert [k in turning.poses for k in range(4)] == [True, False, False, False]
    np.testing.assert_allclose(turning.poses.newest(turning.map), np.eye(4))  # the log's last two are there still
    assert np.isfinite(turning.poses.predict(turning.map)).all()


def test_where_the_camera_was_lost_in_between_the_turn_stays_as_it_was(turning):
    turning.localizer.lose()
    turning.localizer._end_turn(*seen_from([0.04, 0.0, 0.0]))
    for k in (1, 2, 3):
        np.testing.assert_allclose(inverse(turning.poses.pose(k, turning.map))[:3, 3], 0.0, atol=1e-12)
