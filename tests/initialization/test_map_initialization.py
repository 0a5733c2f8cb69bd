# SPDX-License-Identifier: Apache-2.0
"""The first map."""

import dataclasses

import numpy as np
from scenes import PINHOLE, arc_poses, project, view_of

from vitamin3d.config import Config, InitializationConfig
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.initialization.map_initialization import build_first_map
from vitamin3d.initialization.two_view_initialization import initialize_from_two_views

CONFIG = InitializationConfig()


def views_of_arc(rng, count=400, sigma_px=0.3):
    points = rng.uniform([-2.2, -1.6, 4.0], [2.2, 1.6, 8.0], (count, 3))
    poses = arc_poses(7)
    pixels = [project(PINHOLE, T, points) + sigma_px * rng.standard_normal((count, 2)) for T in poses]
    return points, poses, [view_of(k, np.arange(count), p) for k, p in enumerate(pixels)]


def test_the_first_map_is_the_truth_up_to_scale(rng):
    points, poses, views = views_of_arc(rng)
    attempt = initialize_from_two_views(views[0].ideal_pixels, views[-1].ideal_pixels, PINHOLE, CONFIG)
    first = build_first_map(attempt.view, np.arange(400), views, PINHOLE, Config())
    assert first is not None
    np.testing.assert_array_equal(first.map.T_cam_world[0], np.eye(4))
    assert 0.95 < np.nanmedian(first.map.points_world[:, 2]) < 1.05
    scale = np.median(points[:, 2]) / np.nanmedian(first.map.points_world[:, 2])
    error = np.linalg.norm(scale * first.map.points_world - points, axis=1) / points[:, 2]
    assert np.isfinite(error).mean() > 0.95 and np.nanmedian(error) < 0.01
    indices = [view.frame.index for view in first.keyframe_views]
    assert indices == first.map.frame_indices and indices[0] == 0 and indices[-1] == 6 and len(indices) > 3
    centers = scale * inverse(first.map.T_cam_world)[:, :3, 3]
    np.testing.assert_allclose(centers, inverse(poses[indices])[:, :3, 3], atol=0.04)


def test_a_wrong_pair_does_not_become_a_map(rng):
    _, _, views = views_of_arc(rng)
    attempt = initialize_from_two_views(views[0].ideal_pixels, views[-1].ideal_pixels, PINHOLE, CONFIG)
    wrong = dataclasses.replace(attempt.view, T_1_0=exp_se3(np.array([1.0, 0, 0, 0, 0, 0.5])))
    scrambled = [views[0], view_of(6, np.arange(400), rng.uniform(0, 480, (400, 2)))]
    assert build_first_map(wrong, np.arange(400), scrambled, PINHOLE, Config()) is None
