# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import texture, warped

from vitamin3d.config import CurvatureConfig, ExtremaConfig, RecoveryConfig
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.image.curvature import curvature
from vitamin3d.image.extrema import detect_extrema, refine_extrema
from vitamin3d.mapping.landmark_recovery import (
    _climb_strict,
    _visible_candidates,
    cut_patches,
    patch_similarity,
    recover_landmarks,
    same_landmarks,
)
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Tracks

CAMERA = PinholeCamera(260.0, 255.0, 160.0, 119.0, 320, 240)
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
