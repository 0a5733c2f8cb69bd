# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import EUROC, PINHOLE, map_of, orbit, texture

from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.rolling_shutter import NO_MOTION, at_one_moment, fit_image_motion, ideal_pixels, measured_pixels, row_shift
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement
from vitamin3d.mapping.readout_estimation import _block_starts, estimate_readout, frame_interval_s, set_image_motion
from vitamin3d.types import Frame

CONFIG = CalibrationConfig(
    first_keyframes=5, points_per_keyframe=60, readout_points=60, systematic_factor=3.0, readout_systematic_factor=3.0, parameters="f"
)
READOUT = 0.03
PAN = np.array([[300.0, 20.0], [40.0, 0.0], [0.0, 30.0], [10.0, 0.0], [0.0, 5.0], [0.0, 0.0]])


def rolling(camera, readout=READOUT):
    return dataclasses.replace(camera, readout_s=readout)


def pixels_in(camera, rng, n=500):
    return rng.uniform(0, 1, (n, 2)) * [camera.width - 1, camera.height - 1]


def velocity(pixels, motion, camera):
    """The slow obvious twin: the polynomial term by term."""
    x, y = pixels[:, 0] / camera.width - 0.5, pixels[:, 1] / camera.height - 0.5
    return sum(np.outer(term, row) for term, row in zip((x**0, x, y, x * x, x * y, y * y), motion, strict=True))


# --- the image's motion ------------------------------------------------------------------------------------------


def test_the_motion_is_fitted_in_spite_of_things_that_move_otherwise(rng):
    now = pixels_in(PINHOLE, rng)
    before = now - 0.05 * velocity(now, PAN, PINHOLE) + 0.1 * rng.standard_normal(now.shape)
    before[::6] += 30.0
    found = fit_image_motion(before, now, 0.05, PINHOLE)
    assert np.abs(velocity(now, found, PINHOLE) - velocity(now, PAN, PINHOLE)).max() < 0.2 / 0.05


def test_too_few_pairs_or_no_time_between_them_are_no_motion(rng):
    pixels = pixels_in(PINHOLE, rng, 59)
    assert not fit_image_motion(pixels, pixels + 5.0, 0.1, PINHOLE).any()
    pixels = pixels_in(PINHOLE, rng)
    assert not fit_image_motion(pixels, pixels + 5.0, 0.0, PINHOLE).any()


def test_the_shift_is_the_velocity_times_the_time_since_the_middle_row():
    at = np.array([[100.0, (PINHOLE.height - 1) / 2], [100.0, PINHOLE.height - 0.5], [100.0, -0.5]])
    expected = velocity(at, PAN, PINHOLE) * np.array([[0.0], [0.5], [-0.5]])
    np.testing.assert_allclose(row_shift(at, PAN, PINHOLE), expected, atol=1e-9)


# --- pixels of one moment ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [PINHOLE, EUROC])
def test_ideal_and_measured_pixels_are_inverse(camera, rng):
    measured = pixels_in(camera, rng)
    ideal = ideal_pixels(measured, PAN, rolling(camera))
    assert np.nanmax(np.abs(ideal - camera.undistort(measured))) > 3.0
    seen = np.isfinite(ideal[:, 0])
    np.testing.assert_allclose(measured_pixels(ideal, PAN, rolling(camera))[seen], measured[seen], atol=1e-5)


def test_without_a_readout_time_it_is_the_lens_alone(rng):
    measured = pixels_in(EUROC, rng)
    np.testing.assert_array_equal(ideal_pixels(measured, PAN, EUROC), EUROC.undistort(measured))
    np.testing.assert_array_equal(measured_pixels(measured, PAN, EUROC), EUROC.distort(measured))


def seen_row_by_row(camera, points, twist):
    """Each point where it is when its row is read; the camera moves by `twist` per second from the middle row's moment."""
    v = camera.ideal_from_points(points)[:, 1]
    out = np.empty((len(points), 2))
    for i, point in enumerate(points):
        row = v[i]
        for _ in range(20):
            time = camera.readout_s * ((row + 0.5) / camera.height - 0.5)
            out[i] = camera.ideal_from_points((exp_se3(time * twist) @ [*point, 1.0])[None, :3])[0]
            row = out[i, 1]
    return out


def test_what_a_turning_camera_reads_row_by_row_is_carried_to_one_moment(rng):
    camera, twist = rolling(PINHOLE), np.array([0.1, 0.05, 0.0, 0.3, 0.8, 0.2])
    points = np.column_stack([rng.uniform(-1.5, 1.5, (400, 2)), rng.uniform(2.0, 4.0, 400)])
    truth, measured = camera.ideal_from_points(points), seen_row_by_row(camera, points, twist)
    seen = camera.is_inside(measured)
    truth, measured, points = truth[seen], measured[seen], points[seen]
    before, after = (camera.ideal_from_points(points @ T[:3, :3].T + T[:3, 3]) for T in (exp_se3(-0.03 * twist), exp_se3(0.03 * twist)))
    motion = fit_image_motion(before, after, 0.06, camera)
    motion = fit_image_motion(before + measured - after, measured, 0.06, camera)
    wrong, right = (np.linalg.norm(p - truth, axis=1) for p in (measured, ideal_pixels(measured, motion, camera)))
    assert np.percentile(wrong, 90) > 4.0 and np.percentile(right, 90) < 0.2


def test_a_picture_is_carried_to_one_moment(rng):
    camera, motion = Camera(300, 300, 160, 120, 320, 240, readout_s=0.03), NO_MOTION.copy()
    motion[0, 0] = 400.0
    still = texture(240, 320, rng)
    shifts = 0.03 * ((np.arange(240) + 0.5) / 240 - 0.5) * 400.0
    read = np.stack([np.interp(np.arange(320) - shift, np.arange(320), row) for shift, row in zip(shifts, still, strict=True)])
    frame = at_one_moment(Frame(3, 7, np.round(read).astype(np.uint8), np.repeat(read[..., None], 3, 2).astype(np.uint8)), motion, camera)
    inner = np.s_[8:-8, 16:-16]
    assert np.abs(read[inner] - still[inner]).mean() > 8.0
    assert np.abs(frame.image[inner] - still[inner].astype(float)).mean() < 1.5
    assert np.abs(frame.color[inner][..., 1] - still[inner].astype(float)).mean() < 2.0 and frame.index == 3


def test_a_picture_of_a_camera_at_rest_or_without_rolling_shutter_is_left_alone(rng):
    frame = Frame(0, 0, texture(240, 320, rng))
    assert at_one_moment(frame, NO_MOTION, Camera(300, 300, 160, 120, 320, 240, readout_s=0.03)) is frame
    assert at_one_moment(frame, PAN, Camera(300, 300, 160, 120, 320, 240)) is frame


# --- the readout time from the map -------------------------------------------------------------------------------


def map_read_by(camera, rng, noise_px=0.2):
    """The orbit with every keyframe moving otherwise, its pixels measured by `camera`; the map believes in a global shutter."""
    scene = orbit(camera, 200, rng)
    motions = 0.7 * rng.standard_normal((len(scene.T_cam_world), 1, 1)) * PAN + 100.0 * rng.standard_normal((len(scene.T_cam_world), 6, 2))
    sparse_map = map_of(scene)
    sparse_map.image_motions[:] = motions
    for k, motion in enumerate(motions):
        rows = sparse_map.observations_of(k)
        measured = measured_pixels(sparse_map.obs_pixels[rows], motion, camera)
        noisy = measured + noise_px * rng.standard_normal(measured.shape)
        sparse_map.obs_pixels[rows] = dataclasses.replace(camera, readout_s=0.0).undistort(noisy)
    return sparse_map, np.array(sparse_map.points_world)


def test_the_interval_is_that_of_the_frames_not_of_the_keyframes(rng):
    assert frame_interval_s(map_read_by(PINHOLE, rng)[0]) == pytest.approx(0.1)


@pytest.mark.parametrize("readout", [READOUT, -0.02])
def test_the_readout_time_is_found_and_the_map_moves_along(readout, rng):
    sparse_map, _ = map_read_by(rolling(PINHOLE, readout), rng)
    refinement = CalibrationRefinement(PINHOLE, dataclasses.replace(CONFIG, parameters="f"))
    camera = PINHOLE
    for _ in range(2):
        camera = refinement.refine(sparse_map, camera)
    assert camera.readout_s == pytest.approx(readout, rel=0.05)
    assert estimate_readout(sparse_map, camera, CONFIG).readout_s == pytest.approx(readout, rel=0.03)
    assert abs(camera.readout_s - readout) < 5 * refinement.history[-1].deviations["readout_s"]


def test_a_global_shutter_is_said_to_be_one(rng):
    sparse_map, _ = map_read_by(PINHOLE, rng)
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert refinement.refine(sparse_map, PINHOLE) is PINHOLE
    assert refinement.history[-1].reason == "all rows were read at once"
    assert refinement.refine(sparse_map, PINHOLE) is PINHOLE
    assert sum("readout_s" in r.deviations for r in refinement.history) == 1, "what is settled is not looked for again"
    assert not refinement.wants_image_motion


def test_a_readout_time_that_is_not_known_well_enough_is_looked_for_again(rng):
    sparse_map, _ = map_read_by(PINHOLE, rng)
    refinement = CalibrationRefinement(PINHOLE, dataclasses.replace(CONFIG, settled_readout_deviation=1e-6))
    for _ in range(2):
        refinement.refine(sparse_map, PINHOLE)
    assert sum("readout_s" in r.deviations for r in refinement.history) == 2


def test_a_camera_that_hardly_moves_does_not_tell(rng):
    sparse_map, _ = map_read_by(PINHOLE, rng)
    sparse_map.image_motions[:] *= 1e-3
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert refinement.refine(sparse_map, PINHOLE) is PINHOLE
    assert "does not determine the readout time" in refinement.history[-1].reason


def test_without_motions_or_when_not_asked_for_the_readout_time_is_not_looked_for(rng):
    sparse_map, _ = map_read_by(rolling(PINHOLE), rng)
    unasked = CalibrationRefinement(PINHOLE, dataclasses.replace(CONFIG, readout=False))
    assert unasked.refine(sparse_map, PINHOLE).readout_s == 0.0
    sparse_map.image_motions[:] = 0.0
    refinement = CalibrationRefinement(PINHOLE, CONFIG)
    assert refinement.refine(sparse_map, PINHOLE).readout_s == 0.0
    assert all("readout_s" not in r.deviations for r in (*unasked.history, *refinement.history))


def test_a_better_image_motion_moves_the_keyframes_pixels(rng):
    camera = rolling(EUROC)
    sparse_map, _ = map_read_by(EUROC, rng)
    rows = sparse_map.observations_of(4)
    measured = measured_pixels(sparse_map.obs_pixels[rows], sparse_map.image_motions[4], camera)
    set_image_motion(sparse_map, 4, PAN, camera)
    np.testing.assert_allclose(measured_pixels(sparse_map.obs_pixels[rows], PAN, camera), measured, atol=1e-4)
    before = sparse_map.obs_pixels.copy()
    set_image_motion(sparse_map, 4, 2 * PAN, EUROC)
    np.testing.assert_array_equal(sparse_map.obs_pixels, before)


@pytest.mark.parametrize(("keyframes", "most", "starts"), [(40, 3, [0]), (130, 3, [0, 60, 120]), (444, 3, [0, 180, 420]), (444, 1, [0])])
def test_the_readout_is_looked_for_in_a_few_blocks_spread_over_the_map(keyframes, most, starts):
    assert _block_starts(keyframes, most).tolist() == starts
