# SPDX-License-Identifier: Apache-2.0
import copy

import numpy as np
import pytest
import reference
from scenes import PINHOLE, map_of

from vitamin3d.config import TriangulationConfig
from vitamin3d.mapping.landmark_triangulation import Rigidity, triangulate_landmarks
from vitamin3d.sparse_map import SparseMap


def two_keyframes(points, T_1_0, offset_1=(0.0, 0.0), deviations_deg=(0.0, 0.0)):
    """A map without points of two keyframes that see all points."""
    result = SparseMap()
    for k, T in enumerate((np.eye(4), T_1_0)):
        pixels = np.array([reference.residual(PINHOLE.intrinsics, T, X, np.zeros(2)) for X in points]) + k * np.asarray(offset_1)
        n = len(points)
        colors, patches = np.zeros((n, 3), np.uint8), np.zeros((n, 81), np.uint8)
        result.add_keyframe(k, k, T, np.arange(n), pixels, colors, patches, position_deviation_deg=deviations_deg[k])
    return result


SIDEWAYS = np.eye(4)
SIDEWAYS[0, 3] = -0.2


def test_tracks_get_their_points(rng):
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (40, 3))
    sparse_map = two_keyframes(points, SIDEWAYS)
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == 40
    np.testing.assert_allclose(sparse_map.points_world, points, rtol=1e-9)
    sparse_map.points_world[:] += 1.0
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == 0  # they have points
    np.testing.assert_allclose(sparse_map.points_world, points + 1, rtol=1e-9)


def test_points_need_parallax():
    points = np.array([[0.0, 0, 10], [0, 0, 12]])  # 0.2 units apart: 1.15° and 0.95°
    sparse_map = two_keyframes(points, SIDEWAYS)
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(min_parallax_deg=1.0)) == 1
    np.testing.assert_array_equal(sparse_map.is_mapped(np.arange(2)), [True, False])


@pytest.mark.parametrize(
    ("deviations_deg", "counts"),
    [((0.0, 0.0), (2, 2)), ((0.06, 0.08), (1, 2)), ((0.08, 0.06), (1, 2)), ((0.09, 0.12), (0, 2)), ((0.0, 90.0), (0, 2))],
)
def test_points_need_more_parallax_where_the_cameras_places_are_uncertain(deviations_deg, counts):
    points = np.array([[0.0, 0, 10], [0, 0, 12]])  # 1.15° and 0.95°
    for factor, count in zip((10.0, 0.0), counts, strict=True):
        sparse_map, config = two_keyframes(points, SIDEWAYS, (0.0, 0.0), deviations_deg), TriangulationConfig(parallax_deviations=factor)
        assert triangulate_landmarks(sparse_map, PINHOLE, config) == count
        assert sparse_map.is_mapped(np.arange(2)).tolist() == [count > 0, count > 1]


def test_each_track_is_judged_by_the_keyframe_where_it_began():
    """The first of three keyframes knows its place badly; the same points are seen from there and from the second."""
    points, sparse_map = np.array([[0.0, 0, 10], [0.5, 0, 10], [0, 0.5, 10], [0.5, 0.5, 10]]), SparseMap()
    for k, (ids, shift, deviation_deg) in enumerate((([0, 1], 0.0, 0.3), ([0, 1, 2, 3], 0.0, 0.0), ([0, 1, 2, 3], -0.2, 0.01))):
        T, n = np.eye(4), len(ids)
        T[0, 3] = shift
        pixels = np.array([reference.residual(PINHOLE.intrinsics, T, X, np.zeros(2)) for X in points[ids]])
        empty = np.zeros((n, 3), np.uint8), np.zeros((n, 81), np.uint8)
        sparse_map.add_keyframe(k, k, T, np.array(ids), pixels, *empty, position_deviation_deg=deviation_deg)
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == 2
    assert sparse_map.is_mapped(np.arange(4)).tolist() == [False, False, True, True]


def test_rigidity_counts_the_tracks_with_parallax_and_those_that_agree():
    near, far = [[0.1 * k, 0.0, 5.0] for k in range(10)], [[0.1 * k, 0.0, 50.0] for k in range(7)]
    sparse_map, rigidity = two_keyframes(np.array([*near, *far]), SIDEWAYS), Rigidity()
    assert (rigidity.num_tracks, rigidity.num_rigid, rigidity.share) == (0, 0, 1.0)
    sparse_map.obs_pixels[17:20] += [0.0, 40.0]  # three move by themselves
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(), rigidity) == 7
    assert (rigidity.num_tracks, rigidity.num_rigid, rigidity.share) == (10, 7, 0.7)
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(), rigidity) == 0  # the three once more
    assert (rigidity.num_tracks, rigidity.num_rigid) == (13, 7)


def test_rigidity_counts_no_landmark_that_disagrees_between(scene):
    """First and newest view alone would make one of it."""
    sparse_map, rigidity = map_of(scene, with_points=False), Rigidity()
    newest = sparse_map.obs_landmark[sparse_map.observations_of(7)]
    sliding = np.isin(sparse_map.obs_landmark, newest[:20])
    keyframes = sparse_map.keyframe_of(np.arange(len(sliding)))
    sparse_map.obs_pixels[sliding & (keyframes > 1) & (keyframes < 7)] += [6.0, 0.0]
    made = triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(), rigidity)
    assert made == len(newest) - 20 and (rigidity.num_tracks, rigidity.num_rigid) == (len(newest), made)


def test_a_scene_of_things_that_move_is_hardly_rigid(rng):
    rigidity = Rigidity()
    sparse_map = two_keyframes(rng.uniform([-1, -1, 2], [1, 1, 5], (400, 3)), SIDEWAYS)
    sparse_map.obs_pixels[400:] += rng.uniform(-60, 60, (400, 2))
    triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(), rigidity)
    assert rigidity.num_tracks > 350 and rigidity.share < 0.15


def test_points_need_to_reproject():
    points = np.array([[0.1, 0.2, 3.0]])
    for offset, count in ((5.8, 1), (6.3, 0)):  # half of a sideways offset in each picture, above 3 px too much
        sparse_map = two_keyframes(points, SIDEWAYS, (0.0, offset))
        config = TriangulationConfig(max_reprojection_px=3.0, max_rms_px=0.0)
        assert triangulate_landmarks(sparse_map, PINHOLE, config) == count, offset


def test_points_need_all_their_observations_to_agree(scene, rng):
    """What slides along an edge, or steps from one extremum to the next, may fit the first and the newest view."""
    sparse_map = map_of(scene, with_points=False)
    seen = [np.flatnonzero(scene.obs_point == p) for p in range(300)]
    newest = [p for p in range(300) if scene.obs_camera[seen[p][-1]] == 7]
    stepping, sliding, jittery, removed = newest[:4]
    sparse_map.obs_pixels[seen[stepping][1:-1]] += [4.0, 0.0]
    sparse_map.obs_pixels[seen[sliding][1:-1], 0] += 3.0 * np.sin(np.linspace(0, np.pi, len(seen[sliding]))[1:-1])
    sparse_map.obs_pixels[seen[jittery][1:-1]] += 0.5 * rng.choice([-1, 1], (len(seen[jittery]) - 2, 2))
    middle = seen[removed][len(seen[removed]) // 2]
    sparse_map.obs_pixels[middle] += [40.0, 0.0]
    sparse_map.obs_valid[middle] = False
    strict, paper = copy.deepcopy(sparse_map), TriangulationConfig(max_rms_px=0.0)
    assert triangulate_landmarks(strict, PINHOLE, TriangulationConfig()) == len(newest) - 2
    assert strict.is_mapped(np.array(newest)).tolist() == [False, False] + [True] * (len(newest) - 2)
    short = copy.deepcopy(sparse_map)
    assert triangulate_landmarks(short, PINHOLE, TriangulationConfig(checked_keyframes=1)) == len(newest)
    assert triangulate_landmarks(sparse_map, PINHOLE, paper) == len(newest)
    np.testing.assert_array_equal(strict.points_world[newest[2:]], sparse_map.points_world[newest[2:]])


def test_points_need_to_lie_in_front():
    sparse_map = two_keyframes(np.array([[0.0, 0.0, 3.0]]), SIDEWAYS, (80.0, 0.0))  # the rays part
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == 0
    assert np.isnan(sparse_map.points_world).all()


def test_points_need_their_observations():
    sparse_map = two_keyframes(np.array([[0.0, 0.0, 3.0]]), SIDEWAYS)
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig(min_observations=3)) == 0
    sparse_map.obs_valid[1] = False
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == 0


def test_only_the_newest_keyframes_tracks_and_their_counting_observations(scene):
    sparse_map = map_of(scene, with_points=False)
    newest = sparse_map.obs_landmark[sparse_map.observations_of(7)]
    sparse_map.remove_landmarks(newest[:5])  # these start afresh: no earlier observation is left
    assert triangulate_landmarks(sparse_map, PINHOLE, TriangulationConfig()) == len(newest) - 5
    np.testing.assert_allclose(sparse_map.points_world[newest[5:]], scene.points[newest[5:]], rtol=1e-8)
    others = np.setdiff1d(np.arange(300), newest[5:])
    assert np.isnan(sparse_map.points_world[others]).all()
