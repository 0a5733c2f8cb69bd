# SPDX-License-Identifier: Apache-2.0
"""Windows, frames and whole maps that are adjusted, and what comes out of the map as an outlier."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, Late, arc_scene, map_of, perturbed, project, rotation_error_deg, with_noise

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.config import BundleAdjustmentConfig, Config, WindowConfig
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.mapping.map_adjustment import MapAdjustment
from vitamin3d.mapping.map_condensation import condensed
from vitamin3d.mapping.window_adjustment import AdjustAtOnce
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import StepTimes

EXACT = dataclasses.replace(Config(), bundle_adjustment=BundleAdjustmentConfig(points_per_keyframe=0, keyframe_iterations=15))


class Solver:
    """Remembers what it was asked, and moves all points by a step."""

    step = np.array([0.0, 0.0, 0.01])

    def __init__(self):
        self.asked = []

    def __call__(self, problem, camera, config, prior=None):
        self.asked.append((problem, camera, config, prior))
        return dataclasses.replace(problem, points_world=problem.points_world + self.step), None


def adjustment(config=EXACT, adjuster=None, **steps):
    return MapAdjustment(config, adjuster or AdjustAtOnce(), StepTimes(), **steps)


def disturbed_map(scene, rng):
    """The scene's map with poses and points a bit wrong; the first two cameras are right."""
    sparse_map = map_of(scene)
    poses, points = perturbed(scene, rng, 0.005, 0.02)
    poses[1] = scene.T_cam_world[1]
    sparse_map.T_cam_world[:], sparse_map.points_world[:] = poses, points
    return sparse_map


def centre_error(sparse_map, scene):
    """The largest, after the best similarity."""
    a, b = (inverse(T)[:, :3, 3] for T in (sparse_map.T_cam_world, scene.T_cam_world))
    s, R, t = align_sim3(a, b)
    return np.linalg.norm(s * a @ R.T + t - b, axis=1).max()


# --- the window ------------------------------------------------------------------------------------------------------


def test_an_adjusted_window_enters_the_map_once(scene, rng):
    sparse_map, adjusting = disturbed_map(scene, rng), adjustment()
    before, untouched = centre_error(sparse_map, scene), sparse_map.points_world.copy()
    adjusting.begin_window(sparse_map, PINHOLE)
    assert adjusting.adjuster.is_busy
    np.testing.assert_array_equal(sparse_map.points_world, untouched)
    assert len(adjusting.take(sparse_map, PINHOLE)) == 0 and not adjusting.adjuster.is_busy
    assert centre_error(sparse_map, scene) < 0.02 * before
    adjusted = sparse_map.points_world.copy()
    assert len(adjusting.take(sparse_map, PINHOLE)) == 0
    np.testing.assert_array_equal(sparse_map.points_world, adjusted)
    assert len(adjusting.times.milliseconds["bundle_adjustment_keyframe"]) == 1


def test_where_nothing_was_begun_nothing_is_taken(scene):
    sparse_map, adjusting = map_of(scene), adjustment()
    ids = adjusting.take(sparse_map, PINHOLE, wait=True)
    assert ids.shape == (0,) and ids.dtype == np.int64 and sparse_map.obs_valid.all()


def test_what_is_not_done_yet_is_waited_for_or_not(scene, rng):
    sparse_map, adjusting = disturbed_map(scene, rng), adjustment(adjuster=Late())
    before = sparse_map.points_world.copy()
    adjusting.begin_window(sparse_map, PINHOLE)
    adjusting.take(sparse_map, PINHOLE)
    np.testing.assert_array_equal(sparse_map.points_world, before)
    adjusting.take(sparse_map, PINHOLE, wait=True)
    assert (sparse_map.points_world != before).any()


def test_a_keyframe_that_came_meanwhile_moves_along(scene, rng):
    sparse_map, adjusting = disturbed_map(scene, rng), adjustment(adjuster=Late())
    adjusting.begin_window(sparse_map, PINHOLE)
    newer, nothing = exp_se3(np.array([0.2, 0, 0, 0, 0.1, 0])), np.zeros(0, np.int64)
    sparse_map.add_keyframe(
        80, 80, newer @ sparse_map.T_cam_world[7], nothing, np.zeros((0, 2)), np.zeros((0, 3), np.uint8), np.zeros((0, 81), np.uint8)
    )
    adjusting.take(sparse_map, PINHOLE, wait=True)
    np.testing.assert_allclose(sparse_map.T_cam_world[8], newer @ sparse_map.T_cam_world[7], atol=1e-12)


@pytest.mark.parametrize("adjuster", [AdjustAtOnce, Late])
def test_a_solver_of_ones_own_is_asked(scene, adjuster):
    sparse_map, solver = map_of(scene), Solver()
    adjusting = adjustment(adjuster=adjuster(), solve=solver)
    adjusting.begin_window(sparse_map, PINHOLE)
    adjusting.take(sparse_map, PINHOLE, wait=True)
    np.testing.assert_allclose(sparse_map.points_world, scene.points + solver.step)
    ((problem, camera, config, prior),) = solver.asked
    assert camera is PINHOLE and config is EXACT.bundle_adjustment and prior is None
    assert len(problem.T_cam_world) == 8 and len(problem.obs_pixels) == len(scene.pixels)


def test_the_window_is_the_newest_keyframes_and_their_anchors(scene):
    for window, num_free, num_cameras in ((WindowConfig(keyframes=3), 3, 8), (WindowConfig(keyframes=3, anchors=2), 3, 5)):
        solver = Solver()
        adjustment(dataclasses.replace(EXACT, window=window), solve=solver).begin_window(map_of(scene), PINHOLE)
        (problem, *_) = solver.asked[0]
        assert problem.camera_is_free.sum() == num_free and len(problem.T_cam_world) == num_cameras


def test_what_keyframes_knew_when_they_left_the_window_becomes_a_prior_until_it_is_forgotten(rng):
    priors = []

    def solve(problem, camera, config, prior):
        priors.append(prior)
        return adjust_bundle(problem, camera, config, prior)

    scene = arc_scene(9, 120, rng)
    adjusting = adjustment(dataclasses.replace(EXACT, window=WindowConfig(keyframes=4, past="prior")), solve=solve)
    for count in (5, 7, 9):
        sparse_map = map_of(dataclasses.replace(scene, T_cam_world=scene.T_cam_world[:count]))
        adjusting.begin_window(sparse_map, PINHOLE)
        adjusting.take(sparse_map, PINHOLE)
    adjusting.forget_past()
    adjusting.begin_window(sparse_map, PINHOLE)
    assert [prior is None for prior in priors] == [True, False, False, True]


# --- outliers --------------------------------------------------------------------------------------------------------


def with_outliers(scene, first_id=0):
    """A map whose ids begin somewhere, in which landmarks 3 and 40 are wrongly seen in the newest keyframe and 42 in an older one."""
    sparse_map = SparseMap(first_id)
    for k, T in enumerate(scene.T_cam_world):
        mine = scene.obs_point[scene.obs_camera == k]
        pixels = scene.pixels[scene.obs_camera == k].copy()
        pixels[np.isin(mine, [3, 40] if k == 7 else [42] if k == 4 else [])] += [30.0, 10.0]
        colors, patches = np.zeros((len(mine), 3), np.uint8), np.zeros((len(mine), 81), np.uint8)
        sparse_map.add_keyframe(10 * k, k, T, mine.astype(np.int64) + first_id, pixels, colors, patches)
    sparse_map.points_world[:] = scene.points
    return sparse_map


@pytest.mark.parametrize("first_id", [0, 5000])
def test_outliers_of_the_newest_keyframe_come_back_as_ids(scene, first_id):
    sparse_map, adjusting = with_outliers(scene, first_id), adjustment()
    adjusting.begin_window(sparse_map, PINHOLE)
    ids = adjusting.take(sparse_map, PINHOLE)
    assert sorted(ids) == [first_id + 3, first_id + 40]


def test_ids_of_a_map_that_has_forgotten_something_are_still_ids(scene):
    sparse_map = with_outliers(scene, 5000)
    sparse_map.remove_landmarks(np.array([0, 1, 2]))
    sparse_map = condensed(sparse_map, np.arange(8), np.zeros(0, np.int64))
    assert sparse_map.rows_of(np.array([5001, 5003]))[1] == 0
    adjusting = adjustment()
    adjusting.begin_window(sparse_map, PINHOLE)
    assert sorted(adjusting.take(sparse_map, PINHOLE)) == [5003, 5040]


def test_outliers_leave_the_map_wherever_they_were_seen(scene):
    sparse_map, adjusting = with_outliers(scene), adjustment()
    adjusting.begin_window(sparse_map, PINHOLE)
    adjusting.take(sparse_map, PINHOLE)
    removed = {(int(sparse_map.keyframe_of(row)), int(sparse_map.obs_landmark[row])) for row in np.flatnonzero(~sparse_map.obs_valid)}
    assert removed == {(7, 3), (7, 40), (4, 42)}
    np.testing.assert_allclose(sparse_map.points_world[[3, 40, 42]], scene.points[[3, 40, 42]], atol=0.02)


# --- a frame ---------------------------------------------------------------------------------------------------------


def newest_frame(scene, rng):
    """A little further on than the last keyframe, with noise: pose, ids (some unknown to the map) and pixels."""
    T = exp_se3(np.array([-0.2, 0.0, 0.05, 0.0, 0.02, 0.0])) @ scene.T_cam_world[7]
    ids = np.concatenate([np.arange(len(scene.points)), 10_000 + np.arange(50)])
    pixels = project(PINHOLE, T, scene.points) + 0.3 * rng.standard_normal((len(scene.points), 2))
    return T, ids, np.concatenate([pixels, rng.uniform(0, 400, (50, 2))])


def test_without_sweeps_a_frame_stays_where_it_is(scene, rng):
    sparse_map, adjusting = disturbed_map(scene, rng), adjustment()
    T, ids, pixels = newest_frame(scene, rng)
    before = sparse_map.T_cam_world.copy(), sparse_map.points_world.copy()
    assert adjusting.with_frame(sparse_map, PINHOLE, T, ids, pixels) is T
    np.testing.assert_array_equal(sparse_map.T_cam_world, before[0])
    np.testing.assert_array_equal(sparse_map.points_world, before[1])
    assert not adjusting.times.milliseconds


def test_sweeps_move_a_frame_and_the_newest_keyframes_to_where_they_are(scene, rng):
    sparse_map = map_of(scene)
    settings = BundleAdjustmentConfig(sweeps_per_frame=8, frame_keyframes=2, frame_anchors=4)
    adjusting = adjustment(dataclasses.replace(Config(), bundle_adjustment=settings))
    T, ids, pixels = newest_frame(scene, rng)
    wrong = exp_se3(np.array([0.02, -0.02, 0.02, 0.005, 0.005, 0.0]))
    for k in (6, 7):
        sparse_map.T_cam_world[k] = wrong @ sparse_map.T_cam_world[k]
    found = adjusting.with_frame(sparse_map, PINHOLE, wrong @ T, ids, pixels)
    assert rotation_error_deg(found, T) < 0.03 and np.linalg.norm(inverse(found)[:3, 3] - inverse(T)[:3, 3]) < 0.004
    for k in (6, 7):
        assert rotation_error_deg(sparse_map.T_cam_world[k], scene.T_cam_world[k]) < 0.03
    np.testing.assert_array_equal(sparse_map.T_cam_world[:6], scene.T_cam_world[:6])
    assert list(adjusting.times.milliseconds) == ["bundle_adjustment_frame"]


# --- the whole map ---------------------------------------------------------------------------------------------------


def test_the_whole_map_is_adjusted_with_all_observations_and_its_outliers_go(scene, rng):
    noisy, is_outlier = with_noise(scene, rng, 0.3, 0.02)
    sparse_map, adjusting = disturbed_map(noisy, rng), adjustment()
    before = centre_error(sparse_map, scene)
    adjusting.of_whole_map(sparse_map, PINHOLE)
    assert centre_error(sparse_map, scene) < 0.5 * before
    assert (~sparse_map.obs_valid[is_outlier]).mean() > 0.95 and sparse_map.obs_valid[~is_outlier].mean() > 0.99
    assert list(adjusting.times.milliseconds) == ["final_adjustment"]
    np.testing.assert_array_equal(sparse_map.T_cam_world[0], np.eye(4))
