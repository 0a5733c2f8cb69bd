# SPDX-License-Identifier: Apache-2.0
"""The readout time from the map."""

import dataclasses

import numpy as np
import pytest
from scenes import EUROC, PINHOLE, map_of, orbit

from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.rolling_shutter import measured_pixels
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement
from vitamin3d.mapping.readout_estimation import _block_starts, estimate_readout, frame_interval_s, set_image_motion

CONFIG = CalibrationConfig(
    first_keyframes=5, points_per_keyframe=60, readout_points=60, systematic_factor=3.0, readout_systematic_factor=3.0, parameters="f"
)
READOUT = 0.03
PAN = np.array([[300.0, 20.0], [40.0, 0.0], [0.0, 30.0], [10.0, 0.0], [0.0, 5.0], [0.0, 0.0]])


def rolling(camera, readout=READOUT):
    return dataclasses.replace(camera, readout_s=readout)


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
