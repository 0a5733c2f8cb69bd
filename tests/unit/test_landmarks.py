# SPDX-License-Identifier: Apache-2.0
"""Landmarks: triangulated, found again, and what is known about them."""

import copy
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, map_of, texture, warped, with_noise

from vitamin3d.config import CloudConfig, CurvatureConfig, ExtremaConfig, RecoveryConfig, SnapshotConfig, TriangulationConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.mapping.landmark_recovery import (
    _climb_strict,
    _visible_candidates,
    cut_patches,
    patch_similarity,
    recover_landmarks,
    same_landmarks,
)
from vitamin3d.mapping.landmark_statistics import (
    add_squared_errors,
    keyframe_vertices,
    landmark_information,
    landmark_statistics,
    point_cloud,
    relative_depth_deviations,
    unit_information,
)
from vitamin3d.mapping.landmark_triangulation import Rigidity, triangulate_landmarks
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.tracking.curvature import curvature
from vitamin3d.tracking.extrema import detect_extrema, refine_extrema
from vitamin3d.types import Tracks

# --- triangulation -----------------------------------------------------------------------------------------------


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
    sparse_map.obs_pixels[sliding & (sparse_map.obs_keyframe > 1) & (sparse_map.obs_keyframe < 7)] += [6.0, 0.0]
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


@pytest.mark.parametrize("oldest", [0, 3, 7])
def test_squared_errors_equal_their_twin(scene, rng, oldest):
    noisy, _ = with_noise(scene, rng, 1.0)
    sparse_map = map_of(noisy)
    sparse_map.obs_valid[rng.random(len(noisy.pixels)) < 0.2] = False
    ids = rng.permutation(300)[:120]
    first, points = sparse_map.first_observation[ids].copy(), scene.points[ids] + 0.05 * rng.standard_normal((120, 3))
    first[:20] += rng.integers(0, 1500, 20)  # tracks that started afresh
    points[20] = [0.0, 0.0, -3.0]
    wanted = np.full(300, -1, np.int64)
    wanted[ids] = np.arange(120)
    squared, count = np.full(120, 0.5), np.full(120, 2)  # the sums are added to
    poses, starts = sparse_map.T_cam_world, np.array(sparse_map.keyframe_starts)
    R, t = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
    observed = sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.obs_pixels
    add_squared_errors(PINHOLE.intrinsics, R, t, starts, oldest, *observed, first, points, wanted, squared, count)
    for at, id_ in enumerate(ids):
        errors = []
        for k in range(oldest, 8):
            for i in range(starts[k], starts[k + 1]):
                if sparse_map.obs_landmark[i] == id_ and sparse_map.obs_valid[i] and i >= first[at]:
                    r = reference.residual(PINHOLE.intrinsics, poses[k], points[at], sparse_map.obs_pixels[i])
                    errors.append(np.inf if r is None else r @ r)
        assert count[at] == 2 + len(errors)
        assert squared[at] == pytest.approx(0.5 + sum(errors), rel=1e-9)


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


# --- recovery ----------------------------------------------------------------------------------------------------

CAMERA = Camera(260.0, 255.0, 160.0, 119.0, 320, 240)
DEPTH, SHIFT = 5.0, np.array([7.0, -4.0])
MOVED = np.eye(4)
MOVED[:2, 3] = SHIFT * DEPTH / [CAMERA.fx, CAMERA.fy]
CONFIG = RecoveryConfig()


@pytest.fixture
def wall():
    """A flat wall with landmarks on its extrema, seen in three keyframes; a frame in which it has moved by SHIFT pixels."""
    image = texture(240, 320, np.random.default_rng(8), 4.0)
    moved = warped(image, np.eye(2), SHIFT)
    kappa = curvature(image, CurvatureConfig())
    pixels = refine_extrema(kappa, detect_extrema(kappa, ExtremaConfig(border_px=25, min_curvature=20.0)))
    points = CAMERA.rays_from_ideal(pixels) * DEPTH
    sparse_map = SparseMap()
    for k in range(3):
        colors = np.zeros((len(pixels), 3), np.uint8)
        sparse_map.add_keyframe(k, k, np.eye(4), np.arange(len(pixels)), pixels, colors, cut_patches(image, pixels))
    sparse_map.points_world[:] = points
    return sparse_map, pixels, moved, curvature(moved, CurvatureConfig())


def recovered(wall, tracks=None, T=MOVED, config=CONFIG, camera=CAMERA):
    sparse_map, _, image, kappa = wall
    return recover_landmarks(Tracks.empty() if tracks is None else tracks, sparse_map, image, kappa, NO_MOTION, T, camera, config)[0]


def some_tracks(ids, pixels):
    n = len(ids)
    return Tracks(np.array(ids), pixels, np.ones(n, np.float32), np.full(n, 9, np.int32), np.zeros(n, np.int32))


def test_landmarks_are_found_where_they_project(wall):
    found = recovered(wall)
    truth = wall[1][found.ids] + SHIFT
    assert len(wall[1]) > 150 and len(found) > 0.95 * len(wall[1])
    assert np.linalg.norm(found.pixels - truth, axis=1).max() < 0.3
    assert (found.ages == 0).all() and (found.missed == 0).all()
    assert len(np.unique(found.ids)) == len(found)


def candidate_twin(sparse_map, live_ids, T, camera, config):
    """Landmark by landmark: mapped, seen often enough, not live, in the picture, seen from near where it was seen last."""
    canvas, center, found = camera.canvas(), inverse(T)[:3, 3], []
    for id_, point in enumerate(sparse_map.points_world):
        if id_ in live_ids or sparse_map.num_observations[id_] < config.min_observations or np.isnan(point[0]):
            continue
        x, y, z = T[:3, :3] @ point + T[:3, 3]
        if z <= 0 or not 0 < camera.fx * x / z + canvas.cx < canvas.width or not 0 < camera.fy * y / z + canvas.cy < canvas.height:
            continue
        k = sparse_map.keyframe_of(sparse_map.last_observation[[id_]])[0]
        then, now = point - inverse(sparse_map.T_cam_world[k])[:3, 3], point - center
        far, near = sorted((np.linalg.norm(then), np.linalg.norm(now)), reverse=True)
        if np.degrees(np.arccos(then @ now / (far * near))) < config.max_view_angle_deg and far < config.max_distance_ratio * near:
            found.append(id_)
    return found


def test_candidates_equal_their_twin(rng):
    ways = [exp_se3(0.3 * rng.standard_normal(6) * [1, 1, 1, 0.3, 0.3, 0.3]) for _ in range(6)]
    sparse_map, n = SparseMap(), 400
    for k, T in enumerate(ways[:5]):
        ids = rng.permutation(n)[:250]
        empty = np.zeros((250, 2)), np.zeros((250, 3), np.uint8), np.zeros((250, 81), np.uint8)
        sparse_map.add_keyframe(k, k, T, ids, *empty)
    sparse_map.points_world[:] = rng.standard_normal((n, 3)) * [1.0, 0.8, 2.0] + [0, 0, 1.5]
    sparse_map.points_world[::9] = np.nan
    live = np.array([2, 5, 7, n + 3])
    found = _visible_candidates(sparse_map, live, ways[5], CAMERA, CONFIG)
    assert found.tolist() == candidate_twin(sparse_map, live, ways[5], CAMERA, CONFIG) and 20 < len(found) < 200


def test_a_patch_that_disagrees_is_not_found(wall, rng):
    ids = set(recovered(wall).ids.tolist())
    spoilt = np.array(sorted(ids))[::3]
    wall[0].patches[spoilt] = rng.integers(0, 255, (len(spoilt), 81))
    again = set(recovered(wall).ids.tolist())
    assert not again & set(spoilt.tolist()) and again == ids - set(spoilt.tolist())


def test_a_projection_beyond_the_gate_is_not_found(wall):
    ids = recovered(wall).ids
    wall[0].points_world[ids[::2], 0] += 3.5 * DEPTH / CAMERA.fx
    again = recovered(wall).ids
    assert np.isin(ids[1::2], again).all()
    assert np.isin(ids[::2], again).mean() < 0.1


def test_what_is_tracked_is_not_taken_up_again(wall):
    ids = recovered(wall).ids
    live = some_tracks(ids[:20], wall[1][ids[:20]] + SHIFT)
    found = recovered(wall, live)
    np.testing.assert_array_equal(found.ids[:20], ids[:20])
    np.testing.assert_array_equal(found.pixels[:20], live.pixels)
    assert sorted(found.ids.tolist()) == sorted(ids.tolist())


def test_a_landmark_takes_the_place_of_a_mere_track_but_not_of_a_landmark(wall):
    sparse_map, pixels = wall[:2]
    ids = recovered(wall).ids
    mere = some_tracks([5000, 5001], np.array([pixels[ids[0]] + SHIFT, [3.0, 3.0]]))
    found = recovered(wall, mere)
    assert 5000 not in found.ids and 5001 in found.ids and ids[0] in found.ids
    impostor = some_tracks([ids[1]], pixels[ids[:1]] + SHIFT)  # another landmark stands where ids[0] projects
    assert sparse_map.is_mapped(impostor.ids).all()
    found = recovered(wall, impostor)
    assert ids[0] not in found.ids and ids[1] in found.ids


def test_landmarks_that_meet_are_one_where_they_are_near_in_space(wall):
    sparse_map, pixels, image, kappa = wall
    ids = recovered(wall).ids[:4]
    impostors = recovered(wall).ids[-4:]
    sparse_map.points_world[impostors] = sparse_map.points_world[ids] * np.array([1.0, 1.001, 1.001, 1.2])[:, None]
    live = some_tracks(impostors, pixels[ids] + SHIFT)
    tracks, meetings = recover_landmarks(live, sparse_map, image, kappa, NO_MOTION, MOVED, CAMERA, CONFIG)
    assert sorted(meetings.tolist()) == sorted([a, b] for a, b in zip(ids.tolist(), impostors.tolist(), strict=True))
    assert not np.isin(ids, tracks.ids).any()
    same = same_landmarks(np.concatenate([meetings, meetings]), tracks, sparse_map, MOVED, 0.02)
    assert sorted(same.tolist()) == sorted([a, b] for a, b in zip(ids.tolist()[:3], impostors.tolist()[:3], strict=True))
    assert len(same_landmarks(meetings, tracks.select(slice(0, 0)), sparse_map, MOVED, 0.02)) == 0  # no more tracked
    assert same_landmarks(meetings, tracks, sparse_map, MOVED, 0.0).shape == (0, 2)


@pytest.mark.parametrize(("turn_deg", "is_found"), [(25.0, True), (40.0, False)])
def test_landmarks_seen_from_another_direction_are_left(wall, turn_deg, is_found):
    sparse_map = wall[0]
    angle = np.radians(turn_deg)
    T_world_cam = exp_se3(np.array([0, 0, 0, 0, -angle, 0]))
    T_world_cam[:3, 3] = [DEPTH * np.sin(angle), 0, DEPTH * (1 - np.cos(angle))]
    sparse_map.T_cam_world[2] = inverse(T_world_cam)  # the last keyframe looked from the side
    middle = np.flatnonzero(np.linalg.norm(sparse_map.points_world[:, :2], axis=1) < 0.5)
    assert len(middle) > 5
    share = np.isin(middle, recovered(wall).ids).mean()
    assert share > 0.9 if is_found else share == 0.0


@pytest.mark.parametrize(("factor", "is_found"), [(1.15, True), (1.4, False), (0.88, True), (0.7, False)])
def test_landmarks_seen_from_another_distance_are_left(wall, factor, is_found):
    wall[0].T_cam_world[2, 2, 3] = DEPTH * (factor - 1)
    found = recovered(wall)
    assert len(found) > 0.9 * len(wall[1]) if is_found else len(found) == 0


def test_landmarks_with_few_observations_are_left(wall):
    assert len(recovered(wall, config=dataclasses.replace(CONFIG, min_observations=4))) == 0


def test_nothing_is_found_behind_or_outside(wall):
    behind = exp_se3(np.array([0, 0, 0, 0, np.pi, 0]))
    away = np.eye(4)
    away[0, 3] = 100.0
    assert len(recovered(wall, T=behind)) == 0 and len(recovered(wall, T=away)) == 0


def test_patches_equal_their_twin(rng):
    image = rng.integers(0, 255, (23, 31), np.uint8)
    pixels = rng.uniform(-3, [33, 25], (50, 2))
    np.testing.assert_array_equal(cut_patches(image, pixels), [reference.patch(image, p, 4) for p in pixels])
    assert cut_patches(image, pixels[:0]).shape == (0, 81)


def test_similarity_is_the_correlation_coefficient(rng):
    a, b = rng.integers(0, 255, (2, 20, 81), np.uint8)
    b[:10] = np.clip(a[:10] * 0.6 + 40 + rng.normal(0, 5, (10, 81)), 0, 255)
    expected = [np.corrcoef(x.astype(float), y.astype(float))[0, 1] for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(patch_similarity(a, b), expected, atol=1e-10)
    np.testing.assert_allclose(patch_similarity(a, a), 1.0)
    np.testing.assert_allclose(patch_similarity(a, 255 - a), -1.0)
    np.testing.assert_array_equal(patch_similarity(np.full((2, 81), 9, np.uint8), a[:2]), 0.0)


def test_noise_is_taken_off_the_contrast_of_patches(rng):
    clean = 10.0 * rng.standard_normal((500, 81)) + 128
    a, b = (np.clip(clean + 8.0 * rng.standard_normal(clean.shape), 0, 255).astype(np.uint8) for _ in range(2))
    x, y = (patches - patches.mean(axis=1, keepdims=True) for patches in (a.astype(float), b.astype(float)))
    for noise in (0.0, 5.0, 8.0, 200.0):
        of_x, of_y = (np.maximum((z**2).sum(axis=1) - 81 * noise**2, 0.5 * (z**2).sum(axis=1)) for z in (x, y))
        np.testing.assert_allclose(patch_similarity(a, b, noise), (x * y).sum(axis=1) / np.sqrt(of_x * of_y), atol=1e-10)
    assert patch_similarity(a, b).mean() < 0.7 and 0.9 < patch_similarity(a, b, 8.0).mean() < 1.1
    others = patch_similarity(a, b[::-1].copy(), 8.0)
    assert abs(others.mean()) < 0.02 and (others < 0.6).mean() > 0.99


def test_strict_climbing_equals_its_twin(rng):
    kappa = rng.standard_normal((30, 40)).astype(np.float32)
    predicted = rng.uniform(3, [36, 26], (150, 2))
    out, found = np.empty((150, 2)), np.empty(150, np.bool_)
    _climb_strict(kappa, predicted, 4, 2.0, out, found)
    for i, p in enumerate(predicted):
        twin = reference.climbed(kappa, p, 0.0, 1.0, 4, 2.0)
        assert found[i] == (twin is not None)
        if twin is not None:
            np.testing.assert_allclose(out[i], twin, atol=1e-4)
    assert 20 < found.sum() < 145


# --- statistics --------------------------------------------------------------------------------------------------


@pytest.fixture
def noisy_map():
    """Five keyframes, sixty landmarks; observations removed, landmarks without points, one restarted."""
    rng = np.random.default_rng(4)
    result = map_of(with_noise(arc_scene(5, 60, rng), rng, 0.5, 0.0)[0])
    result.remove_observations(rng.choice(len(result.obs_landmark), 30, replace=False))
    result.points_world[[4, 9]] = np.nan
    result.first_observation[7] = np.flatnonzero(result.obs_landmark == 7)[1]
    result.num_observations[7] = len(reference.counting_observations(result, 7))
    return result


def rays_of(sparse_map, id_):
    rows = reference.counting_observations(sparse_map, id_)
    rays = [sparse_map.points_world[id_] - inverse(sparse_map.T_cam_world[k])[:3, 3] for _, k in rows]
    return rows, [ray / np.linalg.norm(ray) for ray in rays]


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4], [0, 4, 2, 3, 1], [2, 4, 3, 0, 1]], ids=["away", "there and back", "both ways"])
def test_statistics_equal_their_twin(noisy_map, order):
    noisy_map.T_cam_world[:] = noisy_map.T_cam_world[order]
    statistics = landmark_statistics(noisy_map, PINHOLE)
    assert len(statistics.num_observations) == 60
    for id_ in range(60):
        if np.isnan(noisy_map.points_world[id_, 0]):
            assert statistics.num_observations[id_] == 0
            continue
        rows, rays = rays_of(noisy_map, id_)
        errors = [
            reference.residual(PINHOLE.intrinsics, noisy_map.T_cam_world[k], noisy_map.points_world[id_], noisy_map.obs_pixels[i])
            for i, k in rows
        ]
        assert statistics.num_observations[id_] == len(rows) == noisy_map.num_observations[id_]
        assert statistics.reprojection_rms_px[id_] == pytest.approx(np.sqrt(np.mean([e @ e for e in errors])), rel=1e-9)
        end = max(rays, key=lambda ray: angle_deg(rays[0], ray))
        assert statistics.parallax_deg[id_] == pytest.approx(max(angle_deg(end, ray) for ray in rays), abs=1e-5)


def test_information_equals_its_twin(noisy_map):
    ids = np.flatnonzero(np.isfinite(noisy_map.points_world[:, 0]))[::-1]
    found = landmark_information(noisy_map, ids, PINHOLE, SnapshotConfig(min_observation_sigma_px=0.05, shared_error=0.5))
    for H, id_ in zip(found, ids, strict=True):
        expected, squared, rows = np.zeros((3, 3)), 0.0, reference.counting_observations(noisy_map, id_)
        for _, k in reference.counting_observations(noisy_map, id_):
            _, J = reference.jacobians(PINHOLE.intrinsics, noisy_map.T_cam_world[k], noisy_map.points_world[id_])
            expected += J.T @ J
        for i, k in rows:
            r = reference.residual(PINHOLE.intrinsics, noisy_map.T_cam_world[k], noisy_map.points_world[id_], noisy_map.obs_pixels[i])
            squared += r @ r
        expected /= max(squared / max(2 * len(rows) - 3, 1), 0.05**2) * (1 + 0.5 * len(rows))
        np.testing.assert_allclose(H, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_depth_deviation_is_what_noise_does_to_the_depth(scene, rng):
    """Monte Carlo: one landmark, solved for again and again from noisy pixels."""
    sparse_map, id_, sigma = map_of(scene), 6, 0.7
    rows = reference.counting_observations(sparse_map, id_)
    X, T = sparse_map.points_world[id_], sparse_map.T_cam_world[3]
    J = np.vstack([reference.jacobians(PINHOLE.intrinsics, sparse_map.T_cam_world[k], X)[1] for _, k in rows])
    steps = np.linalg.lstsq(J, sigma * rng.standard_normal((len(J), 20_000)), rcond=None)[0]
    depths = (T[:3, :3] @ (X[:, None] + steps) + T[:3, 3:])[2]
    deviation = relative_depth_deviations(unit_information(sparse_map, np.array([id_]), PINHOLE)[0] / sigma**2, X[None], T)
    assert deviation[0] == pytest.approx(depths.std() / depths.mean(), rel=0.03)


def test_depth_deviation_equals_that_of_the_inverted_information(rng):
    J, X = rng.normal(size=(300, 4, 3)), rng.normal([0.0, 0.0, 5.0], size=(300, 3))
    J[::3, 2:] = 0.0  # undetermined
    J[1::3, :, 2] *= 1e-3  # hardly determined along one axis
    T = np.stack([exp_se3(0.2 * rng.normal(size=6)) for _ in X])
    information = np.einsum("nki,nkj->nij", J, J)
    for poses in (T, T[0]):
        axes, shifts = np.broadcast_to(poses[..., 2, :3], X.shape), np.broadcast_to(poses[..., 2, 3], len(X))
        found = relative_depth_deviations(information, X, poses)
        for n, axis in enumerate(axes):
            if n % 3 == 0:
                assert found[n] == np.inf
            else:
                expected = np.sqrt(axis @ np.linalg.inv(information[n]) @ axis) / (axis @ X[n] + shifts[n])
                assert found[n] == pytest.approx(expected, rel=1e-4)


def test_one_view_leaves_the_depth_open(scene):
    sparse_map = map_of(scene)
    rows = [i for i, _ in reference.counting_observations(sparse_map, 5)]
    sparse_map.obs_valid[rows[1:]] = False
    deviation = relative_depth_deviations(unit_information(sparse_map, np.array([5]), PINHOLE)[0], scene.points[5:6], np.eye(4))
    assert deviation[0] > 1e3


def test_vertices_of_a_keyframe_are_its_good_landmarks(noisy_map):
    pixels, depths, deviations = keyframe_vertices(noisy_map, 3, PINHOLE, SnapshotConfig(min_observations=3))
    mine = noisy_map.obs_landmark[noisy_map.observations_of(3)][noisy_map.obs_valid[noisy_map.observations_of(3)]]
    good = [i for i in mine if noisy_map.is_mapped(np.array([i]))[0] and noisy_map.num_observations[i] >= 3]
    T = noisy_map.T_cam_world[3]
    in_camera = np.array([T[:3, :3] @ noisy_map.points_world[i] + T[:3, 3] for i in good])
    assert 10 < len(good) < 40
    np.testing.assert_allclose(depths, in_camera[:, 2], rtol=1e-12)
    np.testing.assert_allclose(pixels, (in_camera / in_camera[:, 2:] @ PINHOLE.K.T)[:, :2], rtol=1e-10)
    assert ((deviations > 1e-4) & (deviations < 0.05)).all()
    limit = float(np.median(deviations))
    tight = keyframe_vertices(noisy_map, 3, PINHOLE, SnapshotConfig(min_observations=3, max_relative_deviation=limit))
    assert len(tight[1]) == (deviations < limit).sum()


def test_the_cloud_is_filtered(noisy_map):
    statistics = landmark_statistics(noisy_map, PINHOLE)
    config = CloudConfig(min_observations=3, min_parallax_deg=6.0, max_reprojection_rms_px=0.8)
    good = np.isfinite(noisy_map.points_world[:, 0]) & (statistics.num_observations >= 3)
    good &= (statistics.parallax_deg >= 6.0) & (statistics.reprojection_rms_px <= 0.8)
    cloud = point_cloud(noisy_map, PINHOLE, config, SnapshotConfig())
    assert 5 < good.sum() < 55
    np.testing.assert_array_equal(cloud.points_world, noisy_map.points_world[good])
    np.testing.assert_array_equal(cloud.num_observations, statistics.num_observations[good])
    np.testing.assert_array_equal(cloud.colors, noisy_map.colors[good])
    assert ((cloud.depth_deviation > 1e-4) & (cloud.depth_deviation < 0.05)).all()
    assert len(point_cloud(noisy_map, PINHOLE, CloudConfig(min_observations=99), SnapshotConfig()).points_world) == 0
