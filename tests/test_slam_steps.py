# SPDX-License-Identifier: Apache-2.0
"""Steps of one's own take the places of the paper's, in each map of a run."""

import dataclasses

import cv2
import numpy as np
import pytest
from scenes import PINHOLE

from vitamin3d.atlas import Atlas
from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.config import Config
from vitamin3d.localization.localizer import Localizer
from vitamin3d.slam import Slam
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.tracking.tracker import Tracker, TrackIds
from vitamin3d.types import Frame, SlamState, Tracks

NUM_FRAMES = 45


class NotedTracker(Tracker):
    """Notes the frames for which it climbs."""

    def __init__(self, camera, config, ids=None):
        super().__init__(camera, config, ids)
        self.climbed = []

    def climb(self, predicted, front):
        assert predicted.shape == (len(self.tracks), 2)
        self.climbed.append(front.frame.index)
        return super().climb(predicted, front)


class NotedLocalizer(Localizer):
    """Notes the frames that it is asked to locate."""

    def __init__(self, tracker, mapper, poses, config):
        super().__init__(tracker, mapper, poses, config)
        self.located = []

    def locate(self, front):
        self.located.append(front.frame.index)
        return super().locate(front)


def run(demo, steps, num_frames=NUM_FRAMES, num_after_a_cut=0):
    """An atlas after some frames of the demo, and some of others."""
    front_end, atlas = FrontEnd(Config()), Atlas(demo.camera, Config(), steps)
    pictures = [demo.read(index).image for index in range(num_frames)]
    pictures += [cv2.flip(demo.read(100 + index).image, -1) for index in range(num_after_a_cut)]
    for index, picture in enumerate(pictures):
        atlas.process_frame(front_end.process(Frame(index, 50_000_000 * index, picture)))
    return atlas


# --- what they are given ---------------------------------------------------------------------------------------------


def test_each_step_is_made_of_what_it_works_with():
    given, ids, config = [], TrackIds(), Config()

    def tracker(*arguments):
        given.append(arguments)
        return NotedTracker(*arguments)

    def localizer(*arguments):
        given.append(arguments)
        return NotedLocalizer(*arguments)

    slam = Slam(PINHOLE, config, ids=ids, steps=SlamSteps(tracker, localizer, solve=adjust_bundle))
    assert isinstance(slam.tracker, NotedTracker) and isinstance(slam.localizer, NotedLocalizer)
    for found, expected in zip(given, ((PINHOLE, config, ids), (slam.tracker, slam.mapper, slam.poses, config)), strict=True):
        assert all(a is b for a, b in zip(found, expected, strict=True))
    assert slam.mapper.tracker is slam.initializer.tracker is slam.tracker and slam.mapper.adjustment.solve is adjust_bundle


def test_where_nobody_is_named_the_papers_steps_are_taken():
    slam = Slam(PINHOLE, Config())
    assert type(slam.tracker) is Tracker and type(slam.localizer) is Localizer and slam.mapper.adjustment.solve is adjust_bundle


# --- what they do ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noted(demo):
    """A run with steps that note what they are asked, and what the solver was."""
    problems = []

    def solve(problem, camera, config, prior=None):
        problems.append(problem)
        return adjust_bundle(problem, camera, config, prior)

    return run(demo, SlamSteps(NotedTracker, NotedLocalizer, solve), num_after_a_cut=2), problems


@pytest.mark.slow
def test_steps_of_ones_own_are_asked(noted):
    atlas, problems = noted
    slam = atlas.active
    assert slam.map.num_keyframes > 4 and slam.tracker.climbed == [*range(1, NUM_FRAMES), NUM_FRAMES + 1]  # the cut continues none
    first = slam.localizer.located[0]
    assert slam.map.frame_indices[1] < first < NUM_FRAMES and slam.localizer.located == list(range(first, NUM_FRAMES + 2))
    assert problems and all(isinstance(problem, BundleProblem) and len(problem.obs_pixels) > 1000 for problem in problems)


@pytest.mark.slow
def test_each_map_of_a_run_has_them(noted):
    successor = noted[0].successor
    assert isinstance(successor.tracker, NotedTracker) and isinstance(successor.localizer, NotedLocalizer)
    assert successor.mapper.adjustment.solve is noted[0].active.mapper.adjustment.solve
    assert successor.tracker.climbed == [NUM_FRAMES + 1]


@pytest.mark.slow
def test_steps_that_only_take_notes_change_nothing(demo, noted):
    plain, slam = run(demo, None).active, noted[0].active
    for one, other in ((plain.map.points_world, slam.map.points_world), (plain.map.T_cam_world, slam.map.T_cam_world)):
        assert one.tobytes() == other.tobytes()
    assert plain.map.frame_indices == slam.map.frame_indices


@pytest.mark.slow
def test_a_solver_decides_where_the_keyframes_are(demo, noted):
    solved = []

    def move(problem, camera, config, prior=None):
        """Makes the whole window larger, which no picture contradicts."""
        poses = problem.T_cam_world.copy()
        poses[:, :3, 3] *= 1.5
        solved.append(dataclasses.replace(problem, T_cam_world=poses, points_world=1.5 * problem.points_world))
        return solved[-1], None

    slam, other = run(demo, SlamSteps(solve=move)).active, noted[0].active
    count = len(solved[-1].T_cam_world)
    np.testing.assert_array_equal(slam.map.T_cam_world[:count], solved[-1].T_cam_world)
    ratio = np.linalg.norm(slam.map.T_cam_world[1:4, :3, 3], axis=1) / np.linalg.norm(other.map.T_cam_world[1:4, :3, 3], axis=1)
    np.testing.assert_allclose(ratio, 1.5 ** len(solved), rtol=0.1)


@pytest.mark.slow
def test_a_tracker_that_finds_nothing_again_makes_no_map(demo):
    class Forgetful(Tracker):
        def climb(self, predicted, front):
            return Tracks.empty()

    atlas = run(demo, SlamSteps(tracker=Forgetful), 36)
    assert atlas.ranked() == [] and len(atlas.active.tracks) > 100 and (atlas.active.tracks.ages == 0).all()


@pytest.mark.slow
def test_where_a_localizer_does_not_know_the_map_does_not_grow(demo):
    class Doubtful(Localizer):
        def locate(self, front):
            found = super().locate(front)
            self.state = SlamState.UNCERTAIN
            return found

    atlas = run(demo, SlamSteps(localizer=Doubtful), 40)
    slam, states = atlas.active, [note.state for note in atlas.notes]
    first = states.index(SlamState.TRACKING)  # in which the map began
    assert states[first + 1 :] == [SlamState.UNCERTAIN] * (39 - first) and slam.map.frame_indices[-1] == first < 35
    assert all(index in slam.poses for index in range(40))  # good enough for the frames
