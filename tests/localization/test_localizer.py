# SPDX-License-Identifier: Apache-2.0
"""Where the camera is: found by landmarks, followed through a turn, found again, or lost."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_scene, map_of, project, rotation_error_deg, texture, warped

from vitamin3d.config import Config, LocalizationConfig, RecoveryConfig, RelocalizationConfig
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.image.corners import described_corners
from vitamin3d.localization.localizer import Localizer
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.localization.rotation_tracking import unit_rays
from vitamin3d.mapping.map_condensation import condensed
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import DominantFlow, Frame, FrontEndFrame, SlamState, Tracks

PICTURE = np.zeros((PINHOLE.height, PINHOLE.width), np.uint8)
STEP = exp_se3(np.array([-0.3, 0.02, 0.05, 0.0, 0.05, 0.01]))
BLIND = dataclasses.replace(Config(), relocalization=RelocalizationConfig(enabled=False))


class KnownTracks:
    """A tracker whose tracks are told to it."""

    image_motion = NO_MOTION
    num_born, first_id, frame_count, newest_frame = 0, 0, 1, 70

    def __init__(self):
        self.tracks, self.ended = Tracks.empty(), []

    def seen(self):
        seen = self.tracks.select(self.tracks.missed == 0)
        return seen, seen.pixels  # no distortion

    def end(self, ids):
        self.ended += ids.tolist()
        self.tracks = self.tracks.select(~np.isin(self.tracks.ids, ids))

    def end_all(self):
        self.end(self.tracks.ids)

    def show(self, ids, pixels, missed=0):
        n = len(ids)
        ages, missed = np.full(n, 9, np.int32), np.broadcast_to(np.int32(missed), n)
        self.tracks, self.ended = Tracks(np.array(ids, np.int64), np.array(pixels, float), np.ones(n, np.float32), ages, missed), []


class OwnMap:
    """A mapper that finds again what it is told to."""

    def __init__(self, sparse_map, camera=PINHOLE):
        self.map, self.camera, self.asked = sparse_map, camera, []
        self.brings = lambda T: 0

    def recover(self, front, T_cam_world, gate_px=None):
        self.asked.append((front.frame.index, T_cam_world, gate_px))
        return self.brings(T_cam_world)


def front_of(index, picture=PICTURE):
    flow = DominantFlow(np.eye(2), np.zeros(2), 0.0)
    return FrontEndFrame(Frame(index, 10**8 * index, picture), np.zeros((1, 1), np.float32), np.zeros((0, 2)), flow, None, index - 1)


def localizer_of(sparse_map, config=BLIND):
    """After the keyframes of the map."""
    poses = PoseLog()
    for keyframe, index in enumerate(sparse_map.frame_indices):
        poses.add(front_of(index).frame, keyframe, np.eye(4))
    return Localizer(KnownTracks(), OwnMap(sparse_map), poses, config)


def show_points(localizer, scene, T, rng, ids=None, sigma_px=0.3):
    """The tracker sees these points of the scene (all of them) from T; their pixels."""
    ids = np.arange(len(scene.points)) if ids is None else np.asarray(ids)
    pixels = project(PINHOLE, T, scene.points[ids]) + sigma_px * rng.standard_normal((len(ids), 2))
    localizer.tracker.show(ids, pixels)
    return localizer.tracker.tracks.pixels


def is_near(found, T):
    centres = [inverse(pose)[:3, 3] for pose in (found, T)]
    return rotation_error_deg(found, T) < 0.1 and np.linalg.norm(centres[0] - centres[1]) < 0.02


# --- found by landmarks ----------------------------------------------------------------------------------------------


def test_the_camera_is_found_and_tracks_that_disagree_end(scene, rng):
    localizer, T = localizer_of(map_of(scene)), STEP @ scene.T_cam_world[7]
    pixels, wrong = show_points(localizer, scene, T, rng), np.arange(0, 300, 11)
    pixels[wrong] += rng.choice([-25, 25], (len(wrong), 2))
    assert is_near(localizer.locate(front_of(71)), T)
    assert localizer.state is SlamState.TRACKING and sorted(localizer.tracker.ended) == wrong.tolist()
    assert localizer.mapper.asked == []


def test_tracks_that_are_no_landmarks_have_no_say(scene, rng):
    sparse_map, T = map_of(scene), STEP @ scene.T_cam_world[7]
    sparse_map.remove_landmarks(np.arange(0, 300, 2))
    localizer = localizer_of(sparse_map)
    pixels = show_points(localizer, scene, T, rng)
    pixels[::2] = rng.uniform(0, 400, (150, 2))
    tracker = localizer.tracker
    tracker.show([*tracker.tracks.ids, *range(9000, 9200)], np.vstack([pixels, rng.uniform(0, 400, (200, 2))]))
    assert is_near(localizer.locate(front_of(71)), T) and localizer.state is SlamState.TRACKING
    assert not set(tracker.ended) & {*range(0, 300, 2), *range(9000, 9200)}


def test_landmarks_with_many_observations_decide(rng):
    """A hundred new ones that agree on another pose have no say against eighty that are known for long."""
    scene = arc_scene(10, 180, rng)
    is_new = scene.obs_point < 100
    kept = ~is_new | (scene.obs_camera >= 8)
    sparse_map = map_of(
        dataclasses.replace(scene, obs_camera=scene.obs_camera[kept], obs_point=scene.obs_point[kept], pixels=scene.pixels[kept])
    )
    localizer, T = localizer_of(sparse_map), STEP @ scene.T_cam_world[9]
    pixels = show_points(localizer, scene, T, rng)
    elsewhere = exp_se3(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.05])) @ T
    pixels[:100] = project(PINHOLE, elsewhere, scene.points[:100])
    assert is_near(localizer.locate(front_of(91)), T)
    assert len(set(localizer.tracker.ended) & set(range(100))) > 90 and not set(localizer.tracker.ended) & set(range(100, 180))


def test_pose_and_map_come_from_the_mapper_of_the_moment(scene, rng):
    """Which may have condensed its map since the last frame: ids stay, rows do not."""
    localizer, T = localizer_of(map_of(scene)), STEP @ scene.T_cam_world[7]
    localizer.mapper.map.remove_landmarks(np.arange(50))
    localizer.mapper.map = condensed(localizer.mapper.map, np.arange(8), np.zeros(0, np.int64))
    show_points(localizer, scene, T, rng)
    assert is_near(localizer.locate(front_of(71)), T) and not set(localizer.tracker.ended) & set(range(50))


@pytest.mark.parametrize(("frame_count", "enabled", "is_asked"), [(2, True, True), (3, True, False), (4, True, True), (2, False, False)])
def test_every_few_frames_landmarks_are_found_again(scene, rng, frame_count, enabled, is_asked):
    localizer = localizer_of(map_of(scene), dataclasses.replace(BLIND, recovery=RecoveryConfig(enabled=enabled, interval=2)))
    T = STEP @ scene.T_cam_world[7]
    show_points(localizer, scene, T, rng, range(150))
    localizer.tracker.frame_count = frame_count

    def bring(T_cam_world):
        assert is_near(T_cam_world, T)
        show_points(localizer, scene, T, rng, sigma_px=0.0)[299] += 40.0
        return 150

    localizer.mapper.brings = bring
    assert is_near(localizer.locate(front_of(71)), T)
    assert [(index, gate_px) for index, _, gate_px in localizer.mapper.asked] == ([(71, None)] if is_asked else [])
    assert (299 in localizer.tracker.ended) == is_asked  # the pose was refined with them


def test_a_pose_is_refined_with_all_landmarks_that_are_tracked(scene, rng):
    localizer, T = localizer_of(map_of(scene)), STEP @ scene.T_cam_world[7]
    show_points(localizer, scene, T, rng)[[4, 9]] += 30.0
    wrong = exp_se3(np.array([0.02, 0.02, 0.0, 0.005, 0.0, 0.0])) @ T
    assert is_near(localizer.refine(wrong), T) and set(localizer.tracker.ended) == {4, 9}
    localizer.tracker.show([], np.zeros((0, 2)))
    np.testing.assert_array_equal(localizer.refine(wrong), wrong)


def test_the_cameras_place_is_known_the_worse_the_noisier_the_pixels(scene, rng):
    localizer, T, deviations = localizer_of(map_of(scene)), STEP @ scene.T_cam_world[7], []
    for sigma_px in (0.1, 1.0, 2.0):
        show_points(localizer, scene, T, rng, sigma_px=sigma_px)[:10] += 500.0  # outliers tell nothing
        deviations.append(localizer.position_deviation_deg(T))
    assert 0.0 < 1.2 * deviations[0] < deviations[1] < 0.7 * deviations[2] < 0.1


# --- uncertain -------------------------------------------------------------------------------------------------------


def few_known(scene, count=8, num_known=5):
    """A map of some keyframes in which all but a few landmarks are new in the last two."""
    kept = ((scene.obs_point < num_known) | (scene.obs_camera >= count - 2)) & (scene.obs_camera < count)
    arrays = (scene.obs_camera[kept], scene.obs_point[kept], scene.pixels[kept])
    fields = dict(zip(("obs_camera", "obs_point", "pixels"), arrays, strict=True))
    return map_of(dataclasses.replace(scene, T_cam_world=scene.T_cam_world[:count], **fields))


def test_a_pose_that_hangs_on_few_known_landmarks_is_uncertain(scene, rng):
    localizer, T = localizer_of(few_known(scene)), STEP @ scene.T_cam_world[7]
    show_points(localizer, scene, T, rng)
    localizer.tracker.frame_count = 2
    assert is_near(localizer.locate(front_of(71)), T) and localizer.state is SlamState.UNCERTAIN and localizer.mapper.asked == []
    for sparse_map, pose in ((few_known(scene, num_known=30), scene.T_cam_world[7]), (few_known(scene, 7), scene.T_cam_world[6])):
        localizer = localizer_of(sparse_map)  # enough are known; a young map does not know better
        show_points(localizer, scene, STEP @ pose, rng)
        assert is_near(localizer.locate(front_of(71)), STEP @ pose) and localizer.state is SlamState.TRACKING


def test_after_a_while_an_uncertain_camera_is_lost(scene, rng):
    config = dataclasses.replace(BLIND, localization=LocalizationConfig(max_loose_frames=3))
    localizer, T, states = localizer_of(few_known(scene), config), STEP @ scene.T_cam_world[7], []
    for index in range(71, 76):
        show_points(localizer, scene, T, rng)
        assert (localizer.locate(front_of(index)) is None) == (index == 74)
        states.append(localizer.state)
    assert states == [*[SlamState.UNCERTAIN] * 3, SlamState.LOST, SlamState.UNCERTAIN]


# --- lost ------------------------------------------------------------------------------------------------------------


def test_without_landmarks_the_camera_is_lost(scene, rng):
    for config in (BLIND, Config()):
        localizer = localizer_of(map_of(scene), config)
        localizer.begin([front_of(index).frame for index in localizer.mapper.map.frame_indices])
        localizer.tracker.show(5000 + np.arange(400), rng.uniform(0, 400, (400, 2)))
        assert localizer.locate(front_of(71)) is None and localizer.state is SlamState.LOST
        localizer.tracker.show([], np.zeros((0, 2)))
        assert localizer.locate(front_of(72)) is None and localizer.state is SlamState.LOST


def test_where_the_landmarks_agree_on_nothing_the_camera_is_lost(scene, rng):
    localizer = localizer_of(map_of(scene))
    localizer.tracker.show(np.arange(300), rng.uniform([0, 0], [640, 480], (300, 2)))
    assert localizer.locate(front_of(71)) is None and localizer.state is SlamState.LOST
    assert localizer.tracker.ended == []


def test_where_most_tracks_coast_the_picture_has_jumped(scene, rng):
    T = STEP @ scene.T_cam_world[7]
    for min_kept_ratio, state in ((0.1, SlamState.TRACKING), (0.3, SlamState.LOST)):
        config = dataclasses.replace(BLIND, localization=LocalizationConfig(min_kept_ratio=min_kept_ratio))
        localizer = localizer_of(map_of(scene), config)
        pixels = show_points(localizer, scene, T, rng)
        localizer.tracker.show(np.arange(300), pixels, missed=np.where(np.arange(300) < 60, 0, 1))
        localizer.locate(front_of(71))
        assert localizer.state is state


def test_a_lost_camera_whose_landmarks_are_back_is_found(scene, rng):
    localizer, T = localizer_of(map_of(scene)), STEP @ scene.T_cam_world[7]
    localizer.lose()
    assert localizer.state is SlamState.LOST
    show_points(localizer, scene, T, rng)
    assert is_near(localizer.locate(front_of(71)), T) and localizer.state is SlamState.TRACKING


# --- a turn ----------------------------------------------------------------------------------------------------------


def turn(degrees):
    return exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.radians(degrees), 0.0]))


@pytest.fixture
def turning(scene, rng):
    """A localizer that knows the directions of 400 tracks without depth, and what shows them to a turned camera."""
    localizer, first = localizer_of(map_of(scene)), scene.T_cam_world[7]
    ids, pixels = 5000 + np.arange(400), rng.uniform([120, 20], [640, 460], (400, 2))
    localizer.tracker.show(ids, pixels)
    localizer.note_directions()
    directions = unit_rays(pixels, PINHOLE) @ first[:3, :3]

    def show(T):
        localizer.tracker.show(ids, project(PINHOLE, np.block([[T[:3, :3], np.zeros((3, 1))], [0, 0, 0, 1]]), directions))

    return localizer, show, first


def test_a_camera_that_turns_away_from_its_landmarks_is_followed_where_it_stands(turning):
    localizer, show, first = turning
    for index in (71, 72):
        T = turn(2.0 * (index - 70)) @ first
        show(T)
        found = localizer.locate(front_of(index))
        np.testing.assert_allclose(found, T, atol=1e-6)
        assert localizer.state is SlamState.ROTATING and localizer.tracker.ended == []
        localizer.poses.add_world(front_of(index).frame, found, localizer.mapper.map)


def test_landmarks_are_looked_for_widely_while_the_camera_turns(turning):
    localizer, show, first = turning
    localizer.tracker.frame_count = 2
    show(turn(2.0) @ first)
    localizer.locate(front_of(71))
    assert [(index, gate_px) for index, _, gate_px in localizer.mapper.asked] == [(71, BLIND.relocalization.gate_px)]


def test_a_lost_camera_is_not_said_to_turn(turning):
    localizer, show, first = turning
    localizer.lose()
    show(turn(2.0) @ first)
    assert localizer.locate(front_of(71)) is None and localizer.state is SlamState.LOST


@pytest.mark.parametrize(("shift", "is_near_by"), [(0.3, True), (3.0, False)])
def test_the_frames_of_a_turn_are_mended_or_given_up_when_landmarks_are_back(scene, rng, turning, shift, is_near_by):
    localizer, show, first = turning
    for index in (71, 72):
        show(turn(2.0 * (index - 70)) @ first)
        localizer.poses.add_world(front_of(index).frame, localizer.locate(front_of(index)), localizer.mapper.map)
    away = np.eye(4)
    away[0, 3] = -shift
    T = away @ turn(2.0) @ first
    show_points(localizer, scene, T, rng)
    assert is_near(localizer.locate(front_of(73)), T) and localizer.state is SlamState.TRACKING
    assert [index in localizer.poses for index in (70, 71, 72)] == [True, is_near_by, is_near_by]
    if is_near_by:
        centres = [inverse(localizer.poses.pose(index, localizer.mapper.map))[:3, 3] for index in (70, 71, 72)]
        way = inverse(T)[:3, 3] - centres[0]
        np.testing.assert_allclose([centres[1] - centres[0], centres[2] - centres[0]], [way / 3, 2 * way / 3], atol=0.01)


def test_the_frames_of_a_turn_are_mended_once(scene, rng, turning):
    localizer, show, first = turning
    sparse_map, poses = localizer.mapper.map, []
    for index, T, is_turn in (
        (71, turn(2.0) @ first, True),
        (72, STEP @ turn(2.0) @ first, False),
        (73, turn(2.0) @ STEP @ turn(2.0) @ first, True),
        (74, STEP @ turn(2.0) @ STEP @ turn(2.0) @ first, False),
    ):
        if is_turn:
            show(T)
        else:
            show_points(localizer, scene, T, rng)
        localizer.poses.add_world(front_of(index).frame, localizer.locate(front_of(index)), sparse_map)
        assert localizer.state is (SlamState.ROTATING if is_turn else SlamState.TRACKING)
        poses.append(localizer.poses.pose(71, sparse_map))
    assert np.abs(poses[1] - poses[0]).max() > 0.01
    np.testing.assert_array_equal(poses[1], poses[3])


def test_a_new_map_knows_no_directions(turning):
    localizer, show, first = turning
    localizer.begin([])
    show(turn(2.0) @ first)
    assert localizer.locate(front_of(71)) is None and localizer.state is SlamState.LOST


@pytest.mark.parametrize(("kept", "state"), [(5000 + np.arange(200), SlamState.ROTATING), (np.arange(300), SlamState.LOST)])
def test_directions_of_tracks_that_the_map_forgot_are_forgotten(turning, kept, state):
    localizer, show, first = turning
    localizer.forget(np.arange(8), kept)
    show(turn(2.0) @ first)
    found = localizer.locate(front_of(71))
    assert localizer.state is state and (found is not None) == (state is SlamState.ROTATING)


# --- found again -----------------------------------------------------------------------------------------------------

SHIFT = np.array([9.0, -6.0])
DEPTH = 5.0


@pytest.fixture
def wall(rng):
    """A map of a flat wall from three keyframes, of which the first shows something else; a picture of the wall, moved by SHIFT."""
    picture, other = texture(480, 640, rng, 4.0), texture(480, 640, rng, 4.0)
    pixels = described_corners(picture, 400)[0]
    n, nothing = len(pixels), np.zeros(0, np.int64)
    sparse_map = SparseMap()
    sparse_map.add_keyframe(0, 0, np.eye(4), nothing, np.zeros((0, 2)), np.zeros((0, 3), np.uint8), np.zeros((0, 81), np.uint8))
    for k in (1, 2):
        sparse_map.add_keyframe(10 * k, k, np.eye(4), 100 + np.arange(n), pixels, np.zeros((n, 3), np.uint8), np.zeros((n, 81), np.uint8))
    sparse_map.points_world[100:] = PINHOLE.rays_from_ideal(pixels) * DEPTH
    T = np.eye(4)
    T[:2, 3] = SHIFT * DEPTH / [PINHOLE.fx, PINHOLE.fy]
    keyframes = [front_of(0, other).frame, front_of(10, picture).frame, front_of(20, picture).frame]
    return sparse_map, keyframes, pixels, front_of(21, warped(picture, np.eye(2), SHIFT)), T


def searching(sparse_map, pixels):
    """A localizer of the map, whose tracks broke; its mapper finds all landmarks again."""
    localizer = localizer_of(sparse_map, Config())
    localizer.tracker.show(9000 + np.arange(10), np.full((10, 2), 50.0))

    def bring(T_cam_world):
        assert not set(localizer.tracker.tracks.ids) & set(range(9000, 9010))  # they have ended
        localizer.tracker.show(100 + np.arange(len(pixels)), pixels + SHIFT)
        return len(pixels)

    localizer.mapper.brings = bring
    return localizer


def test_a_camera_whose_tracks_broke_is_found_by_the_pictures_of_keyframes(wall):
    sparse_map, keyframes, pixels, front, T = wall
    localizer = searching(sparse_map, pixels)
    localizer.begin(keyframes[:1])
    for keyframe in (1, 2):
        localizer.remember(keyframe, keyframes[keyframe])
    assert is_near(localizer.locate(front), T) and localizer.state is SlamState.TRACKING
    assert [gate_px for _, _, gate_px in localizer.mapper.asked] == [Config().relocalization.gate_px, None]


def test_without_the_keyframes_pictures_it_stays_lost(wall):
    sparse_map, keyframes, pixels, front, _ = wall
    localizer = searching(sparse_map, pixels)
    localizer.begin(keyframes[:1])
    assert localizer.locate(front) is None and localizer.state is SlamState.LOST and localizer.mapper.asked == []


def test_a_pose_that_brings_no_landmarks_back_is_none(wall):
    sparse_map, keyframes, pixels, front, _ = wall
    localizer = searching(sparse_map, pixels)
    localizer.begin(keyframes)
    localizer.mapper.brings = lambda T: 0
    assert localizer.locate(front) is None and localizer.state is SlamState.LOST


def test_keyframes_that_were_numbered_anew_are_still_found(wall):
    sparse_map, keyframes, pixels, front, T = wall
    localizer = searching(sparse_map, pixels)
    localizer.begin(keyframes)
    smaller = condensed(sparse_map, np.array([1, 2]), np.zeros(0, np.int64))
    localizer.forget(np.array([1, 2]), smaller.remembered_ids)
    localizer.mapper.map, localizer.poses = smaller, localizer_of(smaller).poses
    assert is_near(localizer.locate(front), T) and localizer.state is SlamState.TRACKING
