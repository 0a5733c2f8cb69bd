# SPDX-License-Identifier: Apache-2.0
"""One map and its owner: keyframes, landmarks that come back, adjustments, and what is forgotten."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, Late, arc_scene, map_of, orbit, perturbed, project, texture, with_noise

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.config import (
    BundleAdjustmentConfig,
    CalibrationConfig,
    Config,
    CurvatureConfig,
    ExtremaConfig,
    FinalAdjustmentConfig,
    KeyframeConfig,
    MemoryConfig,
    MotionCheckConfig,
    RecoveryConfig,
    WindowConfig,
)
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.image.curvature import curvature
from vitamin3d.image.extrema import detect_extrema, refine_extrema
from vitamin3d.image.patches import cut_patches
from vitamin3d.mapping.keyframe_handover import snapshot_of
from vitamin3d.mapping.map_adjustment import MapAdjustment
from vitamin3d.mapping.mapper import Mapper
from vitamin3d.mapping.window_adjustment import AdjustAtOnce
from vitamin3d.sparse_map import SparseMap
from vitamin3d.tracking.tracker import Tracker
from vitamin3d.types import DominantFlow, Frame, FrontEndFrame, StepTimes, Tracks

PICTURE = np.zeros((PINHOLE.height, PINHOLE.width), np.uint8)
STEP = exp_se3(np.array([-0.36, 0.0, 0.0, 0.0, 0.06, 0.0]))
"""About from one keyframe of the arc to the next."""


def front_of(index, picture=PICTURE, kappa=None):
    kappa = np.zeros(picture.shape, np.float32) if kappa is None else kappa
    frame, flow = Frame(index, 10**8 * index, picture), DominantFlow(np.eye(2), np.zeros(2), 0.0)
    return FrontEndFrame(frame, kappa, np.zeros((0, 2), np.int32), flow, None, index - 1)


def tracks_of(ids, pixels):
    n = len(ids)
    return Tracks(np.array(ids, np.int64), pixels, np.ones(n, np.float32), np.full(n, 9, np.int32), np.zeros(n, np.int32))


def mapper_of(sparse_map, camera=PINHOLE, adjuster=None, solve=adjust_bundle, **settings):
    """A map's owner with a tracker that has no tracks yet."""
    config = dataclasses.replace(Config(), **settings)
    mapper = Mapper(camera, Tracker(camera, config), config, MapAdjustment(config, adjuster or AdjustAtOnce(), StepTimes(), solve))
    mapper.begin(sparse_map, [front_of(index).frame for index in sparse_map.frame_indices])
    return mapper


def see(mapper, scene, T, ids=None):
    """The tracker sees these points (all of them) from T."""
    ids = np.arange(len(scene.points)) if ids is None else np.asarray(ids)
    mapper.tracker.take_up(tracks_of(ids, project(PINHOLE, T, scene.points[ids])))


def numbers(taken):
    return [keyframe for keyframe, _ in taken]


# --- a map and its camera --------------------------------------------------------------------------------------------


def test_there_is_no_map_before_it_begins(scene):
    mapper = mapper_of(SparseMap())
    assert mapper.map.num_keyframes == 0 and not mapper.is_adjusting and mapper.condensed_when_due() is None
    mapper.note_image_motion(0, np.ones((6, 2)))
    first = map_of(scene)
    mapper.begin(first, [front_of(index).frame for index in first.frame_indices])
    assert mapper.map is first
    taken = mapper.handover.take_settled(8, 70, everything=True)
    assert [(k, frame.index) for k, frame in taken] == [(k, 10 * k) for k in range(8)]


@pytest.mark.parametrize(
    ("readout_s", "settings", "wanted"),
    [(0.02, {"refine": "off"}, True), (0.0, {"refine": "off"}, False), (0.0, {}, True), (0.0, {"readout": False}, False)],
)
def test_the_images_motion_is_wanted_where_the_shutter_rolls_or_may_be_found_to_roll(readout_s, settings, wanted):
    camera = dataclasses.replace(PINHOLE, readout_s=readout_s)
    assert mapper_of(SparseMap(), camera, calibration=CalibrationConfig(**settings)).wants_image_motion == wanted


def test_only_a_keyframe_just_taken_gets_the_images_motion(scene):
    mapper = mapper_of(map_of(scene), dataclasses.replace(PINHOLE, readout_s=0.02))
    before, motion = mapper.map.obs_pixels.copy(), np.zeros((6, 2))
    motion[0] = [100.0, 0.0]
    mapper.note_image_motion(6 * 10**9, motion)  # keyframe 6 is not the newest
    assert not mapper.map.image_motions.any()
    mapper.note_image_motion(7 * 10**9, motion)
    np.testing.assert_array_equal(mapper.map.image_motions[7], motion)
    assert not mapper.map.image_motions[:7].any()
    newest = mapper.map.observations_of(7)
    np.testing.assert_array_equal(mapper.map.obs_pixels[: newest.start], before[: newest.start])
    assert np.abs(mapper.map.obs_pixels[newest] - before[newest]).max() > 0.5


def test_the_camera_of_another_map_is_inherited_and_the_tracker_has_it_too():
    other = mapper_of(SparseMap(), dataclasses.replace(PINHOLE, fx=511.0))
    mapper = mapper_of(SparseMap())
    mapper.inherit(other)
    assert mapper.camera == other.camera == mapper.tracker.camera and mapper.calibration.given == PINHOLE
    assert mapper.wants_image_motion
    other.calibration._reads_at_once = True  # as it may find out
    mapper.inherit(other)
    assert not mapper.wants_image_motion


def test_a_refined_camera_is_the_trackers_too(rng):
    scene = orbit(PINHOLE, 200, rng)
    wrong = dataclasses.replace(PINHOLE, fx=1.02 * PINHOLE.fx, fy=1.02 * PINHOLE.fy)
    mapper = mapper_of(map_of(scene), wrong, calibration=CalibrationConfig(refine="on", parameters="f", readout=False))
    mapper.refine_calibration()
    assert mapper.camera is mapper.tracker.camera and abs(mapper.camera.fx / PINHOLE.fx - 1) < 0.002
    assert len(mapper.times.milliseconds["self_calibration"]) == 1 and mapper.calibration.history[0].accepted


# --- keyframes -------------------------------------------------------------------------------------------------------


def test_a_frame_becomes_a_keyframe_where_the_picture_moved_or_lost_its_landmarks(scene):
    mapper, here = mapper_of(map_of(scene), keyframes=KeyframeConfig(motion_px=10.0, min_gap=3)), scene.T_cam_world[7]
    aside = exp_se3(np.array([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0])) @ here
    observed = np.unique(scene.obs_point[scene.obs_camera == 7])
    for T, ids, index, expected in (
        (here, observed, 75, False),
        (aside, observed, 75, True),
        (aside, observed, 72, False),  # too soon
        (here, observed[: len(observed) // 2 - 1], 75, True),
        (here, observed[: len(observed) // 2 + 1], 75, False),
        (here, [], 75, True),
    ):
        see(mapper, scene, T, np.asarray(ids, np.int64))
        assert mapper.is_keyframe(front_of(index).frame) == expected, (index, len(ids))


def test_a_keyframe_has_the_tracks_seen_and_makes_landmarks_of_those_with_parallax(scene):
    sparse_map = map_of(scene)
    sparse_map.points_world[250:] = np.nan
    mapper, T = mapper_of(sparse_map), STEP @ scene.T_cam_world[7]
    see(mapper, scene, T)
    assert mapper.add_keyframe(front_of(80), T, 0.01) == 8 == mapper.map.num_keyframes - 1
    assert (mapper.map.frame_indices[8], mapper.map.timestamps_ns[8]) == (80, 8 * 10**9)
    rows = mapper.map.observations_of(8)
    np.testing.assert_array_equal(mapper.map.obs_landmark[rows], np.arange(300))
    np.testing.assert_allclose(mapper.map.obs_pixels[rows], project(PINHOLE, T, scene.points))
    np.testing.assert_allclose(mapper.map.points_world, scene.points, atol=1e-3)
    assert mapper.rigidity.num_tracks == mapper.rigidity.num_rigid == 50 and mapper.map.position_deviations_deg[8] == 0.01
    assert numbers(mapper.handover.take_settled(9, 80, everything=True)) == list(range(9))


def test_every_few_keyframes_the_window_is_adjusted_and_its_outliers_end(scene):
    mapper, T = mapper_of(map_of(scene), bundle_adjustment=BundleAdjustmentConfig(keyframe_interval=2)), scene.T_cam_world[7]
    times, ended = [], []
    for index in range(8, 12):
        T = STEP @ T
        see(mapper, scene, T)
        mapper.tracker.tracks.pixels[index] += [25.0, 10.0]
        mapper.add_keyframe(front_of(10 * index), T, 0.0)
        times.append(len(mapper.times.milliseconds.get("bundle_adjustment_keyframe", [])))
        ended.append(sorted({8, 9, 10, 11} - set(mapper.tracker.tracks.ids)))
    assert times == [1, 1, 2, 2] and ended == [[8], [], [10], []]
    rows = np.flatnonzero(~mapper.map.obs_valid)
    assert {(int(mapper.map.keyframe_of(row)), int(mapper.map.obs_landmark[row])) for row in rows} == {(8, 8), (9, 9), (10, 10)}


def test_what_was_begun_beside_the_tracking_is_waited_for(scene, rng):
    mapper, T = mapper_of(map_of(with_noise(scene, rng, 0.3, 0.0)[0]), adjuster=Late()), STEP @ scene.T_cam_world[7]
    see(mapper, scene, T)
    mapper.add_keyframe(front_of(80), T, 0.0)
    assert mapper.is_adjusting and mapper.adjustment.num_awaited == 0
    mapper.take_adjustment()
    np.testing.assert_array_equal(mapper.map.T_cam_world[8], T)
    moved = mapper.await_adjustment(STEP @ T)
    assert not mapper.is_adjusting and mapper.adjustment.num_awaited == 1
    assert np.abs(mapper.map.T_cam_world[8] - T).max() > 1e-6
    np.testing.assert_allclose(moved, STEP @ mapper.map.T_cam_world[8], atol=1e-12)  # as the keyframe moved it


def test_a_frame_that_is_no_keyframe_may_be_adjusted_with_the_newest_ones(scene):
    T = STEP @ scene.T_cam_world[7]
    wrong = exp_se3(np.array([0.01, 0.01, 0.0, 0.003, 0.0, 0.0])) @ T
    for sweeps, limit in ((0, None), (6, 1e-3)):
        mapper = mapper_of(map_of(scene), bundle_adjustment=BundleAdjustmentConfig(sweeps_per_frame=sweeps))
        see(mapper, scene, T)
        found = mapper.adjust_with_frame(wrong)
        assert found is wrong if limit is None else np.abs(found - T).max() < limit


def test_the_whole_map_is_adjusted_at_the_end_where_the_settings_allow_it(scene, rng):
    poses, points = perturbed(scene, rng, 0.005, 0.02)
    for count, settings, is_adjusted in ((8, {}, True), (8, {"enabled": False}, False), (8, {"max_keyframes": 7}, False), (2, {}, False)):
        sparse_map = map_of(dataclasses.replace(scene, T_cam_world=scene.T_cam_world[:count]))
        sparse_map.T_cam_world[:], sparse_map.points_world[:] = poses[:count], points
        final = FinalAdjustmentConfig(**settings)
        mapper_of(sparse_map, final_adjustment=final, calibration=CalibrationConfig(refine="off")).finish()
        assert (np.abs(sparse_map.T_cam_world - poses[:count]).max() > 1e-4) == is_adjusted, settings


def test_a_snapshot_shows_the_map_as_it_is_now(scene):
    mapper, frame = mapper_of(map_of(scene)), front_of(30).frame
    snapshot = snapshot_of(mapper.map, 3, frame, mapper.camera, mapper.config, 5, None)
    assert snapshot.frame is frame and snapshot.map_number == 5 and len(snapshot.depths) > 100
    mapper.map.points_world[:] *= 2.0
    mapper.map.T_cam_world[:, :3, 3] *= 2.0
    np.testing.assert_allclose(snapshot_of(mapper.map, 3, frame, mapper.camera, mapper.config, 5, None).depths, 2.0 * snapshot.depths)


def test_a_bent_map_says_since_when(rng):
    scene, bend = arc_scene(10, 300, rng), exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.radians(4.0), 0.0]))
    for is_bent in (True, False):
        mapper = mapper_of(map_of(with_noise(scene, rng, 0.3, 0.02)[0]), motion_check=MotionCheckConfig(max_keyframes=6, interval=3))
        for k in range(6, 10) if is_bent else ():
            mapper.map.T_cam_world[k] = mapper.map.T_cam_world[k] @ bend
        assert [mapper.is_bent() for _ in range(2)] == [False, is_bent]  # the first time it is a doubt
        assert mapper.last_sound_keyframe() == (5 if is_bent else 9)


# --- landmarks that come back ----------------------------------------------------------------------------------------

SMALL = dataclasses.replace(PINHOLE, fx=260.0, fy=255.0, cx=160.0, cy=119.0, width=320, height=240)
DEPTH = 5.0


def wall(rng, is_doubled=False, **settings):
    """Landmarks on a flat wall in four keyframes, of which the upper half is tracked; doubled: tracked as others that are the same."""
    picture = texture(240, 320, rng, 4.0)
    kappa = curvature(picture, CurvatureConfig())
    pixels = refine_extrema(kappa, detect_extrema(kappa, ExtremaConfig(border_px=25, min_curvature=20.0)))
    count, sparse_map = len(pixels), SparseMap()
    colors, patches = np.zeros((count, 3), np.uint8), cut_patches(picture, pixels)
    for k in range(4):
        ids = np.arange(count) if k < 3 or not is_doubled else count + np.arange(count)
        sparse_map.add_keyframe(k, k, np.eye(4), ids, pixels, colors, patches)
    if is_doubled:
        sparse_map.add_keyframe(4, 4, np.eye(4), count + np.arange(count), pixels, colors, patches)
    sparse_map.points_world[:] = np.tile(SMALL.rays_from_ideal(pixels) * DEPTH, (2 if is_doubled else 1, 1))
    mapper = mapper_of(sparse_map, SMALL, **settings)
    live = np.flatnonzero(pixels[:, 1] < 120)
    mapper.tracker.take_up(tracks_of(live + (count if is_doubled else 0), pixels[live]))
    return mapper, front_of(5, picture, kappa), pixels, live


def test_landmarks_that_come_back_are_tracked_again(rng):
    mapper, front, pixels, live = wall(rng)
    found = mapper.recover(front, np.eye(4))
    tracks = mapper.tracker.tracks
    assert len(tracks) == len(live) + found == len(set(tracks.ids)) and found > 0.9 * (len(pixels) - len(live)) > 20
    np.testing.assert_allclose(tracks.pixels, pixels[tracks.ids], atol=0.3)
    assert mapper.recover(front, np.eye(4)) < 0.1 * found


def test_they_are_looked_for_as_far_as_one_says(rng):
    away = np.eye(4)
    away[0, 3] = 4.0 * DEPTH / SMALL.fx  # four pixels
    near, far = (wall(np.random.default_rng(4))[:2] for _ in range(2))
    assert 10 * near[0].recover(near[1], away) < far[0].recover(far[1], away, gate_px=6.0)


@pytest.mark.parametrize("merge_distance", [0.02, 0.0])
def test_landmarks_that_met_tracked_ones_and_are_the_same_become_one(rng, merge_distance):
    mapper, front, pixels, live = wall(rng, is_doubled=True, recovery=RecoveryConfig(merge_distance=merge_distance))
    count, before = len(pixels), mapper.tracker.tracks
    mapper.recover(front, np.eye(4))
    mapper.tracker.take_up(before)  # the others do not matter here
    mapper.merge_landmarks(np.eye(4))
    after = mapper.tracker.tracks
    np.testing.assert_array_equal(after.pixels, before.pixels)
    if not merge_distance:
        np.testing.assert_array_equal(after.ids, before.ids)
        return
    is_older = after.ids < count
    assert is_older.mean() > 0.9 and set(after.ids[is_older]) <= set(live)
    np.testing.assert_array_equal(after.ids % count, before.ids % count)
    merged = after.ids[is_older]
    assert not mapper.map.is_mapped(merged + count).any() and (mapper.map.num_observations[merged] == 5).all()
    mapper.merge_landmarks(np.eye(4))
    np.testing.assert_array_equal(mapper.tracker.tracks.ids, after.ids)


# --- what may be forgotten -------------------------------------------------------------------------------------------


def points_by_id(sparse_map):
    rows = sparse_map.landmarks
    return dict(zip(sparse_map.ids_of(rows).tolist(), sparse_map.points_world[rows].tolist(), strict=True))


def test_a_map_that_is_cut_back_keeps_landmarks_and_ids(scene):
    mapper = mapper_of(map_of(scene))
    mapper.map.remove_landmarks(np.arange(0, 300, 7))
    see(mapper, scene, scene.T_cam_world[7])
    before = points_by_id(mapper.map)
    done = mapper.cut_back(3)
    assert len(mapper.tracker.tracks) == 0 and mapper.map.num_keyframes == 8  # not yet
    mapper.become(done)
    after = points_by_id(mapper.map)
    num_seen = np.bincount(scene.obs_point[scene.obs_camera <= 3], minlength=300)
    assert after == {id_: point for id_, point in before.items() if num_seen[id_] >= 2} and len(after) > 200
    assert mapper.map.frame_indices == [0, 10, 20, 30]
    np.testing.assert_array_equal(mapper.map.T_cam_world, scene.T_cam_world[:4])
    assert (mapper.map.rows_of(np.arange(0, 300, 7)) == -1).all()
    assert [(k, f.index) for k, f in mapper.handover.take_settled(4, 99, everything=True)] == [(k, 10 * k) for k in range(4)]


def test_a_map_that_was_cut_back_goes_on(scene):
    mapper = mapper_of(map_of(scene), bundle_adjustment=BundleAdjustmentConfig(keyframe_interval=1))
    mapper.become(mapper.cut_back(3))
    new = 1000 + np.arange(300)  # new tracks, of the same points
    for index, T in ((40, scene.T_cam_world[4]), (50, scene.T_cam_world[5]), (60, scene.T_cam_world[6])):
        mapper.tracker.take_up(tracks_of(new, project(PINHOLE, T, scene.points)))
        mapper.add_keyframe(front_of(index), T, 0.0)
    is_mapped, rows = mapper.map.mapped(new)
    assert is_mapped.all() and mapper.map.num_keyframes == 7 and not mapper.is_bent()
    np.testing.assert_allclose(mapper.map.points_world[rows], scene.points, atol=0.01)


def test_nothing_that_was_cut_off_is_called_sound(rng):
    mapper = mapper_of(map_of(with_noise(arc_scene(8, 300, rng), rng, 0.3, 0.02)[0]))
    assert mapper.last_sound_keyframe() == 7
    mapper.become(mapper.cut_back(3))
    assert mapper.last_sound_keyframe() == 3


def test_with_a_smaller_map_the_adjustment_begins_without_a_past(rng):
    priors, scene = [], arc_scene(9, 120, rng)

    def solve(problem, camera, config, prior):
        priors.append(prior)
        return adjust_bundle(problem, camera, config, prior)

    mapper = mapper_of(map_of(scene), solve=solve, window=WindowConfig(keyframes=4, past="prior"))
    for count in (6, 8, 9):
        mapper.map = map_of(dataclasses.replace(scene, T_cam_world=scene.T_cam_world[:count]))
        mapper.adjustment.begin_window(mapper.map, PINHOLE)
        mapper.take_adjustment()
    mapper.become(mapper.cut_back(7))
    mapper.adjustment.begin_window(mapper.map, PINHOLE)
    assert [prior is None for prior in priors] == [True, False, False, True]


def test_tracks_that_ended_and_are_no_landmarks_are_forgotten_once_there_are_many(scene):
    sparse_map = map_of(scene)
    sparse_map.points_world[200:] = np.nan
    mapper = mapper_of(sparse_map, memory=MemoryConfig(max_new_tracks=400), adjuster=Late())
    see(mapper, scene, scene.T_cam_world[7], [*range(100), *range(250, 300)])
    mapper.tracker.num_born = 400
    assert mapper.condensed_when_due() is None
    mapper.tracker.num_born, before = 401, points_by_id(mapper.map)
    mapper.adjustment.begin_window(mapper.map, PINHOLE)
    done = mapper.condensed_when_due()
    assert not mapper.is_adjusting  # its rows are those of the map before
    mapper.become(done)
    assert points_by_id(mapper.map).keys() == before.keys() and mapper.condensed_when_due() is None
    np.testing.assert_array_equal(mapper.map.rows_of(np.arange(200, 250)), -1)
    np.testing.assert_array_equal(mapper.map.rows_of(np.arange(250, 300)), np.arange(200, 250))
    np.testing.assert_array_equal(done.kept_keyframes, np.arange(8))
    mapper.tracker.num_born = 802
    assert mapper.condensed_when_due() is not None and len(mapper.times.milliseconds["condense"]) == 2


def test_the_centres_of_the_keyframes_that_stay_are_where_they_were(rng):
    scene = arc_scene(24, 200, rng)
    few = MemoryConfig(max_keyframes=20, dropped_share=0.15)
    mapper = mapper_of(map_of(scene), memory=few)
    mapper.handover.num_kept = 8
    done = mapper.condensed_when_due()
    mapper.become(done)
    assert mapper.map.num_keyframes == 21 and set(range(16, 24)) <= set(done.kept_keyframes)
    centres = inverse(mapper.map.T_cam_world)[:, :3, 3]
    np.testing.assert_allclose(centres, inverse(scene.T_cam_world)[done.kept_keyframes, :3, 3])
    taken = mapper.handover.take_settled(21, 999, everything=True)
    assert [frame.index for _, frame in taken] == [10 * k for k in done.kept_keyframes] and numbers(taken) == list(range(21))
