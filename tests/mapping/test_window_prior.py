# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_scene

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.config import BundleAdjustmentConfig, Config, WindowConfig
from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.mapping.window_prior import WindowPrior
from vitamin3d.sparse_map import SparseMap

CONFIG = Config(window=WindowConfig(keyframes=7, past="prior"))


@pytest.fixture(scope="module")
def scene():
    """Twelve cameras; each point is seen by four neighbours, exactly."""
    made = arc_scene(12, 720, np.random.default_rng(7))
    first = np.arange(720) % 12 - 2
    is_seen = (made.obs_camera >= first[made.obs_point]) & (made.obs_camera < first[made.obs_point] + 4)
    return dataclasses.replace(made, obs_camera=made.obs_camera[is_seen], obs_point=made.obs_point[is_seen], pixels=made.pixels[is_seen])


def grown(scene, count, noise=0.0):
    """Maps of 1, 2, ... keyframes: one that grows."""
    sparse_map, rng = SparseMap(), np.random.default_rng(1)
    for k, T in enumerate(scene.T_cam_world[:count]):
        mine = scene.obs_camera == k
        pixels = scene.pixels[mine] + noise * rng.standard_normal((mine.sum(), 2))
        colors, patches = np.zeros((len(pixels), 3), np.uint8), np.zeros((len(pixels), 81), np.uint8)
        sparse_map.add_keyframe(k, 10**9 * k, T, scene.obs_point[mine].astype(np.int64), pixels, colors, patches)
        sparse_map.points_world[:] = scene.points[: len(sparse_map.points_world)]
        yield sparse_map


def test_nothing_counts_twice_and_the_prior_holds_the_gauge(scene):
    past, gone_rows = WindowPrior(CONFIG), set()
    for sparse_map in grown(scene, 12):
        count = sparse_map.num_keyframes
        window, problem = past.advance(sparse_map, PINHOLE)
        np.testing.assert_array_equal(window.keyframes, np.arange(max(0, count - 7), count))
        assert (past.prior is None) == (count <= 7) and window.num_fixed == max(0, min(2, count - 1) - window.keyframes[0])
        assert not gone_rows & set(problem.obs_rows)
        every = set(np.concatenate([np.arange(*sparse_map.keyframe_starts[k : k + 2]) for k in window.keyframes]).tolist())
        gone_rows |= every - set(problem.obs_rows.tolist())
    assert len(gone_rows) > 50
    assert past.prior.cameras.tolist() == [0, 1, 2] and np.linalg.eigvalsh(past.prior.information).max() > 1e3


def test_what_left_still_holds_the_window_in_its_place(scene):
    """Of exact pixels a kicked window falls back: the cameras that saw the same as those that left, to where they were."""
    past = WindowPrior(CONFIG)
    for sparse_map in grown(scene, 10):
        window, problem = past.advance(sparse_map, PINHOLE)
    kick = exp_se3(np.array([0.02, -0.01, 0.01, 0.004, -0.003, 0.002]))
    kicked = dataclasses.replace(problem, T_cam_world=kick @ problem.T_cam_world, points_world=1.01 * problem.points_world)
    config = BundleAdjustmentConfig(keyframe_iterations=60, relative_gain=1e-12, points_per_keyframe=0)
    for solver in ("subspace-accelerated", "schur"):
        solved, report = adjust_bundle(kicked, PINHOLE, dataclasses.replace(config, keyframe_solver=solver), past.prior)
        np.testing.assert_allclose(solved.T_cam_world[:2], scene.T_cam_world[window.keyframes[:2]], atol=1e-3)
        assert (np.diff(report.costs) <= 1e-9).all() and report.costs[-1] < 0.1
    assert past.prior.cameras.tolist() == [0, 1]
    alone, _ = adjust_bundle(kicked, PINHOLE, config)
    assert np.abs(alone.T_cam_world - scene.T_cam_world[window.keyframes])[:2].max() > 5e-3


def test_outliers_do_not_enter_the_prior(scene):
    clean, spoilt = WindowPrior(CONFIG), WindowPrior(CONFIG)
    for sparse_map in grown(scene, 8):
        clean.advance(sparse_map, PINHOLE)
    for sparse_map in grown(scene, 8):
        if sparse_map.num_keyframes == 1:
            sparse_map.obs_pixels[::10] += 50.0
        spoilt.advance(sparse_map, PINHOLE)
    assert np.abs(spoilt.prior.gradient).max() < 1e-3 * np.abs(spoilt.prior.information).max()
    assert not np.array_equal(spoilt.prior.information, clean.prior.information)


def test_forgetting_begins_anew(scene):
    past = WindowPrior(CONFIG)
    for sparse_map in grown(scene, 10):
        past.advance(sparse_map, PINHOLE)
    past.forget()
    window, problem = past.advance(sparse_map, PINHOLE)
    assert past.prior is None and window.num_fixed == 2 and (~problem.camera_is_free).sum() == 2


def test_a_solver_without_elimination_is_refused():
    with pytest.raises(InputError, match=r"window.past = 'prior' needs .* not 'subspace'"):
        WindowPrior(dataclasses.replace(CONFIG, bundle_adjustment=BundleAdjustmentConfig(keyframe_solver="subspace")))
