# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference
from scenes import PINHOLE, arc_scene, map_of, with_noise

from vitamin3d.config import CloudConfig, SnapshotConfig
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.mapping.landmark_statistics import (
    add_squared_errors,
    keyframe_vertices,
    landmark_information,
    landmark_statistics,
    point_cloud,
    relative_depth_deviations,
    unit_information,
)


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
