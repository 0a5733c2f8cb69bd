# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import EUROC, PINHOLE, arc_scene, map_of, orbit

from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.reprojection import reprojection_errors
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement

CONFIG = CalibrationConfig(growth=2.0, first_keyframes=5, points_per_keyframe=60, systematic_factor=3.0)


def map_seen_through(true, wrong, rng, noise_px=0.2):
    """The orbit as `true` sees it, in a map whose ideal pixels were computed with `wrong`."""
    scene = orbit(true, 200, rng)
    measured = true.distort(scene.pixels) + noise_px * rng.standard_normal(scene.pixels.shape)
    return map_of(dataclasses.replace(scene, pixels=wrong.undistort(measured))), measured


def errors_of(sparse_map, camera):
    rows = [sparse_map.observations_of(k) for k in range(sparse_map.num_keyframes)]
    return np.concatenate(
        [
            reprojection_errors(T, sparse_map.points_world[sparse_map.obs_landmark[r]], sparse_map.obs_pixels[r], camera.intrinsics)
            for T, r in zip(sparse_map.T_cam_world, rows, strict=True)
        ]
    )


@pytest.mark.parametrize("true", [PINHOLE, EUROC])
def test_a_wrong_calibration_is_replaced_and_the_whole_map_moves_along(true, rng):
    wrong = true.with_model(true.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    sparse_map, measured = map_seen_through(true, wrong, rng)
    refinement = CalibrationRefinement(wrong, CONFIG)
    found = refinement.refine(sparse_map, wrong)
    assert refinement.history[0].accepted and refinement.history[0].camera == found
    assert abs(found.fx / true.fx - 1.0) < 0.003
    np.testing.assert_allclose(found.distort(sparse_map.obs_pixels), measured, atol=1e-6)
    errors = errors_of(sparse_map, found)  # of the points that took no part in the refinement too
    assert np.median(errors) < 0.35 and np.percentile(errors, 99) < 1.5


def test_the_keyframes_that_took_no_part_move_along(rng):
    wrong = EUROC.with_model(EUROC.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    sparse_map, measured = map_seen_through(EUROC, wrong, rng)
    most = sparse_map.num_keyframes // 2
    found = CalibrationRefinement(wrong, dataclasses.replace(CONFIG, max_keyframes=most, points_per_keyframe=200)).refine(sparse_map, wrong)
    assert most > 4 and abs(found.fx / EUROC.fx - 1.0) < 0.005
    np.testing.assert_allclose(found.distort(sparse_map.obs_pixels), measured, atol=1e-6)
    errors = errors_of(sparse_map, found)
    medians = [np.median(errors[sparse_map.observations_of(k)]) for k in range(sparse_map.num_keyframes)]
    assert max(medians) < 0.4 and np.percentile(errors, 99) < 1.5


def test_a_right_calibration_is_kept_as_it_is(rng):
    sparse_map, _ = map_seen_through(PINHOLE, PINHOLE, rng)
    before = sparse_map.obs_pixels.copy(), sparse_map.points_world.copy()
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert refinement.refine(sparse_map, PINHOLE) is PINHOLE
    assert not refinement.history[0].accepted and "agrees" in refinement.history[0].reason
    np.testing.assert_array_equal(sparse_map.obs_pixels, before[0])
    np.testing.assert_array_equal(sparse_map.points_world, before[1])


def test_after_one_refinement_the_given_calibration_counts_no_more(rng):
    wrong = PINHOLE.with_model(PINHOLE.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    sparse_map, _ = map_seen_through(PINHOLE, wrong, rng)
    refinement = CalibrationRefinement(wrong, CONFIG)
    found = refinement.refine(sparse_map, refinement.refine(sparse_map, wrong))
    assert [r.accepted for r in refinement.history] == [True, True]
    assert abs(found.fx / PINHOLE.fx - 1.0) < 0.003


def straight_ahead(rng):
    """Six cameras that move along their axis without turning: focal length and depth cannot be told apart."""
    scene = arc_scene(6, 150, rng)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = -0.3 * np.arange(6)
    seen = np.einsum("nij,nj->ni", poses[scene.obs_camera, :3, :3], scene.points[scene.obs_point]) + poses[scene.obs_camera, :3, 3]
    pixels = PINHOLE.ideal_from_points(seen) + 0.2 * rng.standard_normal((len(seen), 2))
    return map_of(dataclasses.replace(scene, T_cam_world=poses, pixels=pixels))


def test_motion_that_does_not_determine_the_focal_length_is_said_so(rng):
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert refinement.refine(straight_ahead(rng), PINHOLE) is PINHOLE
    assert "does not determine the focal length" in refinement.history[0].reason
    assert refinement.history[0].deviations["f"] > 0.01 * PINHOLE.fx


def test_on_believes_what_auto_refuses(rng):
    refinement = CalibrationRefinement(PINHOLE, dataclasses.replace(CONFIG, refine="on"))
    found = refinement.refine(straight_ahead(rng), PINHOLE)
    assert refinement.history[0].accepted and found != PINHOLE


def test_a_focal_length_far_from_the_given_one_is_refused_even_then(rng):
    wrong = PINHOLE.with_model(PINHOLE.model * [1.03, 1.03, 1, 1, 1, 1, 1, 1])
    sparse_map, _ = map_seen_through(PINHOLE, wrong, rng)
    refinement = CalibrationRefinement(wrong, dataclasses.replace(CONFIG, refine="on", max_change=0.01))
    assert refinement.refine(sparse_map, wrong) is wrong
    assert "too far" in refinement.history[0].reason


def test_refinements_are_due_as_the_map_grows(rng):
    sparse_map, _ = map_seen_through(PINHOLE, PINHOLE, rng)
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert [refinement.is_due(n) for n in (4, 5, 12)] == [False, True, True]
    refinement.refine(sparse_map, PINHOLE)
    assert [refinement.is_due(n) for n in (12, 23, 24)] == [False, False, True]
    assert not CalibrationRefinement(PINHOLE, dataclasses.replace(CONFIG, refine="off")).is_due(100)
