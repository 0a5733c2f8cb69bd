# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import EUROC, PINHOLE, texture

from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.rolling_shutter import NO_MOTION, at_one_moment, fit_image_motion, ideal_pixels, measured_pixels, row_shift
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import Frame

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
    camera, motion = PinholeCamera(300, 300, 160, 120, 320, 240, readout_s=0.03), NO_MOTION.copy()
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
    assert at_one_moment(frame, NO_MOTION, PinholeCamera(300, 300, 160, 120, 320, 240, readout_s=0.03)) is frame
    assert at_one_moment(frame, PAN, PinholeCamera(300, 300, 160, 120, 320, 240)) is frame
