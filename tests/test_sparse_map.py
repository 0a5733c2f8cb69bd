# SPDX-License-Identifier: Apache-2.0
import numpy as np
import reference
from scenes import map_of

from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.sparse_map import SparseMap


def add(sparse_map, ids, seed=0, T=None):
    rng, n, k = np.random.default_rng(seed), len(ids), sparse_map.num_keyframes
    pixels, colors = rng.uniform(0, 400, (n, 2)), rng.integers(0, 255, (n, 3), np.uint8)
    patches = rng.integers(0, 255, (n, 81), np.uint8)
    sparse_map.add_keyframe(10 * k, 10**9 * k, np.eye(4) if T is None else T, np.array(ids, np.int64), pixels, colors, patches)
    return pixels, colors, patches


def check_counts(sparse_map):
    """Counts, first and last agree with what the observations say."""
    for id_ in range(len(sparse_map.points_world)):
        rows = reference.counting_observations(sparse_map, id_)
        assert sparse_map.num_observations[id_] == (len(rows) if sparse_map.first_observation[id_] >= 0 else 0), id_


def test_observations_are_stored_by_keyframe():
    sparse_map = SparseMap()
    pixels_0, *_ = add(sparse_map, [3, 0])
    pixels_1, colors_1, patches_1 = add(sparse_map, [0, 5, 3], 1)
    assert (sparse_map.num_keyframes, sparse_map.keyframe_starts) == (2, [0, 2, 5])
    assert (sparse_map.frame_indices, sparse_map.timestamps_ns) == ([0, 10], [0, 10**9])
    np.testing.assert_array_equal(sparse_map.obs_landmark, [3, 0, 0, 5, 3])
    np.testing.assert_array_equal(sparse_map.obs_pixels, np.vstack([pixels_0, pixels_1]))
    np.testing.assert_array_equal(sparse_map.keyframe_of(np.arange(len(sparse_map.obs_landmark))), [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(sparse_map.obs_pixels[sparse_map.observations_of(1)], pixels_1)
    np.testing.assert_array_equal(sparse_map.num_observations, [2, 0, 0, 2, 0, 1])
    np.testing.assert_array_equal(sparse_map.first_observation, [1, -1, -1, 0, -1, 3])
    np.testing.assert_array_equal(sparse_map.last_observation, [2, -1, -1, 4, -1, 3])
    np.testing.assert_array_equal(sparse_map.colors[[0, 5, 3]], colors_1)
    np.testing.assert_array_equal(sparse_map.patches[[0, 5, 3]], patches_1)
    check_counts(sparse_map)


def test_how_well_the_places_of_keyframes_are_known_is_kept():
    sparse_map, empty = SparseMap(), (np.zeros((1, 2)), np.zeros((1, 3), np.uint8), np.zeros((1, 81), np.uint8))
    assert sparse_map.position_deviations_deg.shape == (0,)
    for k in range(300):
        sparse_map.add_keyframe(k, k, np.eye(4), np.array([0]), *empty, position_deviation_deg=0.1 * k)
    add(sparse_map, [0, 1])  # where nothing is said it is known exactly
    np.testing.assert_array_equal(sparse_map.position_deviations_deg, [*(0.1 * k for k in range(300)), 0.0])


def test_keyframe_of_is_the_keyframe_of_each_observation():
    sparse_map = SparseMap()
    for ids in ([0, 1], [], [2], [0, 1, 2]):
        add(sparse_map, ids)
    np.testing.assert_array_equal(sparse_map.keyframe_of(np.arange(len(sparse_map.obs_landmark))), [0, 0, 2, 3, 3, 3])


def test_a_track_is_mapped_once_it_has_a_point():
    sparse_map = SparseMap()
    add(sparse_map, [0, 1, 2])
    np.testing.assert_array_equal(sparse_map.is_mapped(np.array([0, 1, 2, 3, 9999])), False)
    sparse_map.points_world[1] = [1, 2, 3]
    np.testing.assert_array_equal(sparse_map.is_mapped(np.array([2, 1, 9999])), [False, True, False])
    assert sparse_map.is_mapped(np.zeros(0, np.int64)).shape == (0,)


def test_it_grows_beyond_its_first_size():
    sparse_map = SparseMap()
    pixels = [add(sparse_map, range(700 * k, 700 * k + 900), k)[0] for k in range(5)]
    assert len(sparse_map.obs_pixels) == 4500 and len(sparse_map.points_world) == 3700
    np.testing.assert_array_equal(sparse_map.obs_pixels, np.vstack(pixels))
    assert np.isnan(sparse_map.points_world).all() and sparse_map.obs_valid.all()
    sparse_map.points_world[3699] = 1.0
    for k in range(1200):
        add(sparse_map, [5000], k, exp_se3(np.full(6, 1e-3 * k)))
    assert sparse_map.T_cam_world.shape == (1205, 4, 4)
    np.testing.assert_allclose(sparse_map.T_cam_world[1204], exp_se3(np.full(6, 1.199)))
    assert sparse_map.points_world[3699, 0] == 1.0 and sparse_map.num_observations[5000] == 1200
    assert np.isnan(sparse_map.points_world[3700:]).all() and (sparse_map.first_observation[3700:5000] == -1).all()


def test_removed_observations_leave_the_counts():
    sparse_map = SparseMap()
    for _ in range(4):
        add(sparse_map, [0, 1])
    sparse_map.points_world[:] = 1.0
    sparse_map.remove_observations(np.array([0, 2]))
    np.testing.assert_array_equal(sparse_map.num_observations, [2, 4])
    sparse_map.remove_observations(np.array([0, 2]))  # once more changes nothing
    np.testing.assert_array_equal(sparse_map.num_observations, [2, 4])
    np.testing.assert_array_equal(sparse_map.is_mapped(np.arange(2)), [True, True])
    check_counts(sparse_map)
    sparse_map.remove_observations(np.array([4]))  # one is left
    np.testing.assert_array_equal(sparse_map.is_mapped(np.arange(2)), [False, True])
    np.testing.assert_array_equal(sparse_map.num_observations, [0, 4])
    check_counts(sparse_map)
    sparse_map.remove_observations(np.zeros(0, np.int64))
    np.testing.assert_array_equal(sparse_map.num_observations, [0, 4])


def test_observations_before_a_removal_count_no_more():
    sparse_map = SparseMap()
    for _ in range(3):
        add(sparse_map, [0, 1])
    sparse_map.points_world[:] = 1.0
    sparse_map.remove_landmarks(np.array([0]))
    assert sparse_map.first_observation[0] == -1 and sparse_map.num_observations[0] == 0
    add(sparse_map, [0, 1])
    add(sparse_map, [0, 1])
    np.testing.assert_array_equal(sparse_map.num_observations, [2, 5])
    np.testing.assert_array_equal(sparse_map.first_observation, [6, 1])
    assert reference.counting_observations(sparse_map, 0) == [(6, 3), (8, 4)]
    check_counts(sparse_map)


def test_removing_an_old_observation_of_a_restarted_track_leaves_its_count():
    sparse_map = SparseMap()
    for _ in range(3):
        add(sparse_map, [0])
    sparse_map.remove_landmarks(np.array([0]))
    for _ in range(3):
        add(sparse_map, [0])
    sparse_map.points_world[0] = 1.0
    sparse_map.remove_observations(np.array([0, 1]))
    assert sparse_map.num_observations[0] == 3 and sparse_map.is_mapped(np.array([0]))[0]
    check_counts(sparse_map)


def test_a_cloned_pose_is_a_copy(scene):
    sparse_map = map_of(scene)
    pose = sparse_map.clone_pose(2)
    np.testing.assert_array_equal(pose, scene.T_cam_world[2])
    pose[:] = 0
    assert sparse_map.T_cam_world[2].any()


def test_merging_gives_the_observations_to_one_landmark():
    sparse_map = SparseMap()
    for k, ids in enumerate(([0, 1, 2], [0, 2], [0, 1, 3], [3, 1], [3, 2, 1])):
        add(sparse_map, ids, k)
    sparse_map.points_world[:] = np.arange(12.0).reshape(4, 3)
    sparse_map.remove_observations(np.array([9]))  # landmark 1 in keyframe 3
    patches = sparse_map.patches.copy()
    sparse_map.merge_landmarks(np.array([0]), np.array([3]))
    rows = reference.counting_observations(sparse_map, 0)
    assert [k for _, k in rows] == [0, 1, 2, 3, 4]  # in keyframe 2 both were seen: that of 0 stays
    assert rows[2][0] == 5 and not sparse_map.obs_valid[7]
    assert sparse_map.num_observations[0] == 5 and (sparse_map.first_observation[0], sparse_map.last_observation[0]) == (0, 10)
    assert not sparse_map.is_mapped(np.array([3]))[0] and reference.counting_observations(sparse_map, 3) == []
    np.testing.assert_array_equal(sparse_map.points_world[0], [0, 1, 2])  # as many observations each: the kept one's
    np.testing.assert_array_equal(sparse_map.patches[0], patches[3])  # the latest looks
    np.testing.assert_array_equal(sparse_map.points_world[[1, 2]], [[3, 4, 5], [6, 7, 8]])
    check_counts(sparse_map)


def test_merging_does_not_revive_what_no_longer_counts():
    sparse_map = SparseMap()
    for k, ids in enumerate(([0, 1], [0, 1], [0], [1], [0])):
        add(sparse_map, ids, k)
    sparse_map.points_world[:] = 1.0
    sparse_map.remove_landmarks(np.array([0]))  # starts afresh below
    add(sparse_map, [0], 5)
    add(sparse_map, [0], 6)
    sparse_map.points_world[0] = 2.0
    sparse_map.merge_landmarks(np.array([0]), np.array([1]))
    assert [k for _, k in reference.counting_observations(sparse_map, 0)] == [0, 1, 3, 5, 6]
    np.testing.assert_array_equal(sparse_map.obs_landmark[sparse_map.obs_valid], [0, 0, 0, 0, 0])
    np.testing.assert_array_equal(sparse_map.points_world[0], 1.0)  # three observations against two
    check_counts(sparse_map)
