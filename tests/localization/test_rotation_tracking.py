# SPDX-License-Identifier: Apache-2.0
"""A camera that turns without travelling."""

import dataclasses
import weakref

import cv2
import numpy as np
import pytest
from scenes import PINHOLE, project, texture
from scipy.spatial.transform import Rotation

from vitamin3d.config import Config, RotationConfig
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.localization.rotation_tracking import Directions, Turns, rotation_of, unit_rays
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame, SlamState

CONFIG = RotationConfig()
PICTURE = np.zeros((480, 640), np.uint8)


def rotation(x_deg, y_deg, z_deg):
    return Rotation.from_euler("xyz", [x_deg, y_deg, z_deg], degrees=True).as_matrix()


def angle_deg(A, B):
    return np.degrees(Rotation.from_matrix(A @ B.T).magnitude())


def frame(index):
    return Frame(index, 50 * index, PICTURE, np.zeros((480, 640, 3), np.uint8))


def sky(rng, R, count=400, outlier_share=0.0, sigma_px=0.3):
    """Directions in the world and pixels at which a camera turned by R sees them; which are outliers."""
    pixels = rng.uniform([0, 0], [640, 480], (count, 2))
    directions = unit_rays(pixels, PINHOLE) @ R
    is_outlier = np.arange(count) < outlier_share * count
    pixels = pixels + sigma_px * rng.standard_normal((count, 2))
    pixels[is_outlier] = rng.uniform([0, 0], [640, 480], (is_outlier.sum(), 2))
    return directions, pixels, is_outlier


# --- a rotation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("from_deg", [0.0, 1.0, 5.0])
def test_a_rotation_is_found_among_thirty_percent_outliers(seed, from_deg):
    rng = np.random.default_rng(seed)
    R = rotation(*rng.uniform(-60, 60, 3))
    directions, pixels, _ = sky(rng, R, 400, 0.3, 0.5)
    before = rotation(from_deg, -0.5 * from_deg, 0.2 * from_deg) @ R
    turn = rotation_of(directions, pixels, rng.integers(0, 30, 400), before, PINHOLE, CONFIG)
    assert angle_deg(turn.R_cam_world, R) < 0.1 and not turn.is_doubtful
    np.testing.assert_allclose(turn.R_cam_world @ turn.R_cam_world.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn.R_cam_world) == pytest.approx(1.0)


def test_without_noise_it_is_exact(rng):
    R = rotation(3.0, -40.0, 9.0)
    directions, pixels, _ = sky(rng, R, 60, 0.0, 0.0)
    directions[7] = np.nan  # a new track has no direction
    turn = rotation_of(directions, pixels, np.arange(60), np.eye(3), PINHOLE, CONFIG)
    np.testing.assert_allclose(turn.R_cam_world, R, atol=1e-9)


def test_tracks_on_one_line_give_a_rotation_and_no_mirror(rng):
    for _ in range(20):
        R, pixels = rotation(*rng.uniform(-9, 9, 3)), np.column_stack([rng.uniform(0, 640, 80), np.full(80, PINHOLE.cy)])
        turn = rotation_of(unit_rays(pixels, PINHOLE) @ R, pixels, np.arange(80), np.eye(3), PINHOLE, CONFIG)
        np.testing.assert_allclose(turn.R_cam_world, R, atol=1e-9)


def test_too_few_tracks_tell_nothing(rng):
    directions, pixels, _ = sky(rng, np.eye(3), 60)
    ages = np.ones(60, int)
    assert rotation_of(directions[:49], pixels[:49], ages[:49], np.eye(3), PINHOLE, CONFIG) is None
    directions[:11] = np.nan
    assert rotation_of(directions, pixels, ages, np.eye(3), PINHOLE, CONFIG) is None
    assert rotation_of(directions[:0], pixels[:0], ages[:0], np.eye(3), PINHOLE, CONFIG) is None


def test_too_small_a_share_tells_nothing(rng):
    """300 of 1000 agree: others may travel."""
    directions, pixels, _ = sky(rng, np.eye(3), 1000, 0.7)
    ages = np.ones(1000, int)
    assert rotation_of(directions, pixels, ages, np.eye(3), PINHOLE, CONFIG) is None
    assert rotation_of(directions, pixels, ages, np.eye(3), PINHOLE, dataclasses.replace(CONFIG, min_share=0.2)) is not None


def test_it_can_be_switched_off(rng):
    directions, pixels, _ = sky(rng, np.eye(3))
    off = dataclasses.replace(CONFIG, enabled=False)
    assert rotation_of(directions, pixels, np.ones(400, int), np.eye(3), PINHOLE, off) is None


def test_a_turn_is_doubtful_where_the_older_tracks_agree_less(rng):
    ages = rng.permutation(400)
    for share, is_doubtful in ((0.0, False), (0.1, False), (0.5, True)):
        directions, pixels, _ = sky(rng, np.eye(3))
        pixels[(ages >= 200) & (rng.random(400) < share)] += [8.0, 0.0]
        assert rotation_of(directions, pixels, ages, np.eye(3), PINHOLE, CONFIG).is_doubtful == is_doubtful, share


# --- a camera on its way ---------------------------------------------------------------------------------------------


def flight(rng, num_frames, step, R_step):
    """What is claimed of each frame of a camera among points all around, 3 to 10 units away; and the error in degrees."""
    rays = rng.standard_normal((6000, 3))
    points = rays / np.linalg.norm(rays, axis=1, keepdims=True) * rng.uniform(3, 10, (6000, 1))
    directions, R, found, born = Directions(), np.eye(3), np.eye(3), np.full(6000, -1)
    turns, errors = [], []
    for k in range(num_frames):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ (k * np.asarray(step))
        pixels = project(PINHOLE, T, points) + 0.3 * rng.standard_normal((6000, 2))
        ids = np.flatnonzero(((points @ T[:3, :3].T + T[:3, 3])[:, 2] > 0.5) & PINHOLE.is_inside(pixels))
        born[ids[born[ids] < 0]] = k
        turn = rotation_of(directions.of(ids), pixels[ids], k - born[ids], found, PINHOLE, CONFIG)
        turns.append(turn)
        found = found if turn is None else turn.R_cam_world
        errors.append(angle_deg(found, R))
        directions.note(ids, pixels[ids], found if k else R, PINHOLE)
        R = R_step @ R
    return turns[1:], errors[1:]


def test_a_turn_all_around_stays_true_and_is_never_doubted(rng):
    turns, errors = flight(rng, 91, [0.0, 0, 0], rotation(0.0, 4.0, 0.0))
    assert not any(turn is None or turn.is_doubtful for turn in turns)
    assert max(errors[:20]) < 0.1 and max(errors) < 0.5


@pytest.mark.parametrize("step", [[0.02, 0, 0], [0.06, 0, 0], [0, 0.03, 0], [0.0, 0, 0.1], [0.03, 0.03, 0.03]])
@pytest.mark.parametrize("turning_deg", [0.0, 1.0])
def test_a_travelling_camera_is_refused_or_doubted(rng, step, turning_deg):
    turns, _ = flight(rng, 31, step, rotation(0.0, turning_deg, 0.0))
    is_doubted = [turn is None or turn.is_doubtful for turn in turns]
    most = CONFIG.max_doubts + 1
    assert any(all(is_doubted[k : k + most]) for k in range(len(turns) - most)), is_doubted


# --- directions ------------------------------------------------------------------------------------------------------


def test_directions_are_those_of_the_first_sight(rng):
    directions, ids, pixels = Directions(), np.array([2, 5, 3]), rng.uniform(100, 300, (3, 2))
    R = rotation(10.0, 20.0, -5.0)
    directions.note(ids, pixels, R, PINHOLE)
    rays = np.column_stack([(pixels - [PINHOLE.cx, PINHOLE.cy]) / [PINHOLE.fx, PINHOLE.fy], np.ones(3)])
    expected = np.array([R.T @ (ray / np.linalg.norm(ray)) for ray in rays])
    np.testing.assert_allclose(directions.of(ids), expected, atol=1e-12)
    directions.note(np.array([5, 9]), pixels[:2], np.eye(3), PINHOLE)  # 5 is known
    np.testing.assert_allclose(directions.of(np.array([5, 2])), expected[[1, 0]], atol=1e-12)
    np.testing.assert_allclose(directions.of(np.array([9])), unit_rays(pixels[1:2], PINHOLE), atol=1e-12)
    assert np.isnan(directions.of(np.array([0, 4, 10, 10**6]))).all()


def test_no_directions_at_all():
    directions, none = Directions(), np.zeros(0, np.int64)
    directions.note(none, np.zeros((0, 2)), np.eye(3), PINHOLE)
    assert directions.of(none).shape == (0, 3) and np.isnan(directions.of(np.array([0]))).all()
    directions.keep(none)
    assert directions.of(none).shape == (0, 3)


@pytest.mark.parametrize("first_id", [0, 700])
def test_directions_of_some_tracks_are_kept(rng, first_id):
    directions = Directions(first_id)
    directions.note(first_id + np.arange(3000), rng.uniform(0, 480, (3000, 2)), np.eye(3), PINHOLE)
    kept, gone = first_id + np.array([1, 4, 2999, 5000]), first_id + np.array([0, 2, 2998])
    before = directions.of(kept)
    directions.keep(kept)
    np.testing.assert_array_equal(directions.of(kept), before)
    directions.note(np.append(gone, first_id + np.array([5000, 5001])), np.zeros((5, 2)), np.eye(3), PINHOLE)
    assert np.isnan(directions.of(gone)).all()  # they are forgotten for good
    assert np.isfinite(directions.of(np.append(kept, first_id + 5001))).all()


# --- chains of turns -------------------------------------------------------------------------------------------------


def turned(k, step_deg=2.0):
    return rotation(0.3 * step_deg * k, step_deg * k, 0.0)


def chain(count=6, step_deg=2.0):
    turns = Turns()
    for k in range(count):
        turns.add(frame(10 + k), turned(k, step_deg))
    return turns


def test_a_chain_gives_the_poses_relative_to_the_reference():
    turns = chain()
    np.testing.assert_array_equal(turns.newest, turned(5))
    pairs = turns.since(12)
    assert [kept.index for kept, _ in pairs] == [10, 11, 12, 13, 14, 15]
    for kept, T in pairs:
        np.testing.assert_allclose(T[:3, :3] @ turned(2), turned(kept.index - 10), atol=1e-12)
        np.testing.assert_array_equal(T[:, 3], [0, 0, 0, 1])
        assert kept.timestamp_ns == 50 * kept.index and kept.image.size == 0 and kept.color is None
    assert turns.since(9) == turns.since(16) == Turns().since(0) == []
    np.testing.assert_array_equal(Turns().newest, np.eye(3))


def test_the_pictures_of_a_chain_are_not_kept():
    turns, picture = Turns(), np.zeros((480, 640), np.uint8)
    kept = weakref.ref(picture)
    turns.add(Frame(10, 500, picture), np.eye(3))
    del picture
    assert kept() is None


def test_a_chain_ends_at_the_reference_after_several_doubts_in_a_row():
    turns, parallax = chain(), CONFIG.max_parallax_deg
    doubts = [parallax + 0.1] * (CONFIG.max_doubts - 1)  # never as many in a row as end it
    for deg in (*doubts, parallax, *doubts[1:], 5.0):
        turns.judge(deg, 12, CONFIG)
    assert len(turns.since(12)) == 6 and not turns.ended_before(100)
    turns.judge(parallax + 0.1, 13, CONFIG)
    assert [kept.index for kept, _ in turns.since(12)] == [10, 11, 12, 13]
    assert (turns.ended_before(13), turns.ended_before(14)) == (False, True)
    turns.add(frame(16), rotation(0.0, 50.0, 0.0))
    assert turns.since(16) == [] and not turns.has_turned(CONFIG)
    np.testing.assert_array_equal(turns.newest, rotation(0.0, 50.0, 0.0))


def test_a_chain_that_ends_before_it_began_is_empty():
    turns = chain()
    for _ in range(CONFIG.max_doubts):
        turns.judge(1.0, 3, CONFIG)
    assert turns.since(12) == [] and turns.ended_before(3) and turns.ended_before(-1)


@pytest.mark.parametrize(("step_deg", "has_turned"), [(0.0, False), (0.9, False), (1.1, True), (-1.1, True), (30.0, True)])
def test_the_camera_has_turned_when_it_is_more_than_a_shake(step_deg, has_turned):
    assert chain(6, step_deg).has_turned(CONFIG) == has_turned


# --- in the tracker --------------------------------------------------------------------------------------------------


def test_a_camera_on_a_tripod_turns_and_makes_no_map():
    camera, sky_map = PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240), texture(600, 1600, np.random.default_rng(5), 3.0)
    slam, front_end, states = Slam(camera, Config()), FrontEnd(Config()), []
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = unit_rays(np.column_stack([u.ravel(), v.ravel()]), camera)
    for k in range(30):
        x, y, z = (rays @ rotation(0.0, 0.6 * k, 0.0)).T  # R is of the world to the camera
        at_u, at_v = 500 + 300 * np.arctan2(x, z), 300 + 300 * np.arcsin(y)
        picture = cv2.remap(sky_map, *(a.reshape(240, 320).astype(np.float32) for a in (at_u, at_v)), cv2.INTER_CUBIC)
        states.append(slam.process_frame(front_end.process(Frame(k, 50_000_000 * k, picture))))
    assert slam.map.num_keyframes == len(slam.poses) == 0
    assert states[:8] == [SlamState.INITIALIZING] * 8 and states[-18:] == [SlamState.ROTATING] * 18
    assert angle_deg(slam.initializer._turns.newest, rotation(0.0, 0.6 * 29, 0.0)) < 0.1
    assert "turns but does not travel" in slam.initializer.reason
