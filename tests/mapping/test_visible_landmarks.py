# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import PINHOLE, Scene, arc_poses, map_of, project

from vitamin3d.config import SnapshotConfig
from vitamin3d.mapping.landmark_statistics import keyframe_vertices
from vitamin3d.mapping.visible_landmarks import with_unobserved

CONFIG = SnapshotConfig(unobserved=True, occlusion_radius_px=80.0)
KEYFRAME = 3


@pytest.fixture(scope="module")
def walls():
    """A wall at z = 4 in the left half and one at z = 7 behind it; what the front wall hides was seen from elsewhere.

    Keyframe 3 observes half of what it sees.
    """
    rng = np.random.default_rng(2)
    front = np.column_stack([rng.uniform(-1.6, 0.0, 400), rng.uniform(-1.2, 1.2, 400), np.full(400, 4.0)])
    back = np.column_stack([rng.uniform(-2.6, 2.6, 700), rng.uniform(-2.0, 2.0, 700), np.full(700, 7.0)])
    points, poses = np.concatenate([front, back]), arc_poses(6)
    camera_3 = np.linalg.inv(poses[KEYFRAME])[:3, 3]
    crossing = camera_3 + (points - camera_3) * ((4.0 - camera_3[2]) / (points[:, 2:] - camera_3[2]))
    is_hidden = (points[:, 2] > 5) & (crossing[:, 0] < 0) & (crossing[:, 0] > -1.6) & (np.abs(crossing[:, 1]) < 1.2)
    is_observed = ~is_hidden & (np.arange(len(points)) % 2 == 0)
    obs = []
    for k, T in enumerate(poses):
        inside = PINHOLE.is_inside(project(PINHOLE, T, points), 1.0)
        obs += [(k, p) for p in np.flatnonzero(inside & (is_observed if k == KEYFRAME else True))]
    obs_camera, obs_point = (np.array(column, np.int32) for column in zip(*obs, strict=True))
    pixels = np.array([project(PINHOLE, poses[c], points[p : p + 1])[0] for c, p in obs])
    return map_of(Scene(PINHOLE, poses, points, obs_camera, obs_point, pixels)), is_hidden, is_observed


def test_what_is_seen_joins_and_what_is_hidden_does_not(walls):
    sparse_map, is_hidden, is_observed = walls
    observed = keyframe_vertices(sparse_map, KEYFRAME, PINHOLE, CONFIG)
    more = with_unobserved(observed, sparse_map, KEYFRAME, PINHOLE, CONFIG)
    for one, other in zip(observed, more, strict=True):
        np.testing.assert_array_equal(other[: len(one)], one)
    all_pixels = project(PINHOLE, sparse_map.T_cam_world[KEYFRAME], sparse_map.points_world)
    added = [int(np.linalg.norm(all_pixels - pixel, axis=1).argmin()) for pixel in more.pixels[len(observed.pixels) :]]
    seen = PINHOLE.is_inside(all_pixels) & ~is_hidden & ~is_observed
    assert not is_hidden[added].any() and not is_observed[added].any() and len(set(added)) == len(added)
    assert is_hidden.sum() > 50 and 0.6 * seen.sum() < len(added) <= seen.sum()


def test_too_few_observed_ones_tell_nothing(walls):
    sparse_map = walls[0]
    few = type(keyframe_vertices(sparse_map, KEYFRAME, PINHOLE, CONFIG))(np.zeros((2, 2)), np.ones(2), np.ones(2))
    assert with_unobserved(few, sparse_map, KEYFRAME, PINHOLE, CONFIG) is few


def test_none_are_added_where_the_observed_ones_are_far_or_of_two_surfaces(walls):
    sparse_map = walls[0]
    observed = keyframe_vertices(sparse_map, KEYFRAME, PINHOLE, CONFIG)
    near = SnapshotConfig(unobserved=True, occlusion_radius_px=0.5)
    assert len(with_unobserved(observed, sparse_map, KEYFRAME, PINHOLE, near).depths) == len(observed.depths)
    flat = SnapshotConfig(unobserved=True, occlusion_radius_px=80.0, max_occlusion_range=0.0)
    assert len(with_unobserved(observed, sparse_map, KEYFRAME, PINHOLE, flat).depths) == len(observed.depths)
