# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import (
    Config,
    ConsistencyConfig,
    DelaunayConfig,
    DensificationConfig,
    FusionConfig,
    NltgvConfig,
    SurfaceConfig,
)
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.types import StepTimes

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
NORMAL_WORLD, OFFSET = np.array([0.1, 0.2, 1.0]), 3.0
CONFIG = dataclasses.replace(
    Config(),
    delaunay=DelaunayConfig(min_vertices=20),
    surface=SurfaceConfig(min_component_triangles=20),
    densification=DensificationConfig(enabled=False),
    nltgv=NltgvConfig(data_weight=1.5),
)


def snapshots(count=4, noise=0.01, landmarks=800, unit=1.0):
    """Views of the plane <NORMAL_WORLD, X> = OFFSET from a camera that moves sideways, in map units of `unit`."""
    rng = np.random.default_rng(0)
    for k in range(count):
        T_world_cam = exp_se3(np.array([0.15 * k, -0.05 * k, 0.0, 0.02 * k, -0.03 * k, 0.01]))
        distance = OFFSET - NORMAL_WORLD @ T_world_cam[:3, 3]
        T_world_cam[:3, 3] *= unit
        normal_cam = T_world_cam[:3, :3].T @ NORMAL_WORLD / (distance * unit)
        snapshot = reference.snapshot_of_plane(reference.SMALL, normal_cam, landmarks, rng, noise, inverse(T_world_cam))
        depths = snapshot.depths * (1 + noise * rng.standard_normal(landmarks))
        yield dataclasses.replace(snapshot, depths=depths)


def run(config=CONFIG, **scene):
    reconstruction = Reconstruction(reference.SMALL, config, StepTimes())
    views = [view for snapshot in snapshots(**scene) for view in reconstruction.add_keyframe(snapshot)]
    views += reconstruction.finish()
    return reconstruction, views


def distances(surface):
    return np.abs(surface.vertices_world @ NORMAL_WORLD - OFFSET) / np.linalg.norm(NORMAL_WORLD)


def test_a_noisy_plane_becomes_a_smooth_surface():
    reconstruction, views = run()
    low, high = reconstruction.surfaces()
    assert 0 < np.median(distances(high)) < 0.006 and 0 < np.median(distances(low)) < 0.02
    assert len(high.triangles) > 20 * len(low.triangles) > 0
    toward = high.normals_world @ NORMAL_WORLD / np.linalg.norm(NORMAL_WORLD)
    assert np.median(toward) < -0.995
    assert all(view.depth.max() > 0 for view in views)


def test_all_steps_are_timed():
    reconstruction, _ = run(count=2)
    reconstruction.surfaces()
    counts = {step: len(times) for step, times in reconstruction.times.milliseconds.items()}
    steps = ("meshing", "denoising", "extrapolation", "rendering", "consistency", "fusion_low", "fusion_high")
    each = dict.fromkeys(steps, 2)
    assert counts == {**each, "surface_low": 1, "surface_high": 1}


def test_views_fused_at_a_wrong_pose_are_moved_to_the_right_one():
    config = dataclasses.replace(CONFIG, fusion=FusionConfig(voxel_low=0.15, voxel_high=0.025, backend="blocks", max_depth=1.2))
    right = dict(enumerate(snapshots()))
    stamped = [dataclasses.replace(s, frame=dataclasses.replace(s.frame, timestamp_ns=k)) for k, s in right.items()]
    expected = reconstructed(config, stamped)
    shift = exp_se3(np.array([0.0, 0.0, 0.3, 0.0, 0.05, 0.0]))
    wrong = [dataclasses.replace(s, T_cam_world=shift @ s.T_cam_world) if k in (1, 2) else s for k, s in enumerate(stamped)]
    moved = reconstructed(config, wrong)
    assert moved.fuse_again({k: s.T_cam_world for k, s in right.items()}) == 2
    assert expected.fuse_again({k: s.T_cam_world for k, s in right.items()}) == 0
    for one, other in zip(moved.surfaces(), expected.surfaces(), strict=True):
        assert len(one.triangles) == pytest.approx(len(other.triangles), rel=0.002)
        assert np.abs(np.median(distances(one)) - np.median(distances(other))) < 1e-5
        assert np.quantile(distances(one), 0.99) == pytest.approx(np.quantile(distances(other), 0.99), rel=0.01)
    assert np.median(distances(reconstructed(config, wrong).surfaces()[1])) > 2 * np.median(distances(expected.surfaces()[1]))


def reconstructed(config, keyframes):
    """Fused, the views kept; the votes are off: they would see the wrong poses."""
    config = dataclasses.replace(config, consistency=dataclasses.replace(config.consistency, enabled=False))
    reconstruction = Reconstruction(reference.SMALL, config, keeps_views=True)
    for snapshot in keyframes:
        reconstruction.add_keyframe(snapshot)
    reconstruction.finish()
    return reconstruction


def test_views_are_kept_only_where_they_can_be_moved():
    assert Reconstruction(reference.SMALL, CONFIG, keeps_views=True).volumes.store is None
    blocks = dataclasses.replace(CONFIG, fusion=FusionConfig(backend="blocks"))
    assert Reconstruction(reference.SMALL, blocks).volumes.store is None
    assert Reconstruction(reference.SMALL, blocks, keeps_views=True).volumes.store is not None
    assert Reconstruction(reference.SMALL, CONFIG).fuse_again({}) == 0


def test_keyframes_without_landmarks_are_passed_over():
    reconstruction, views = run(landmarks=10)
    assert views == []
    assert all(len(surface.triangles) == 0 for surface in reconstruction.surfaces())


def test_voxels_follow_the_depth_of_the_scene_or_the_settings():
    reconstruction, _ = run(count=1)
    low, high = reconstruction.volumes.voxel_lengths()
    depth = reconstruction.volumes.median_depths[0]
    assert (low, high) == pytest.approx((depth / 20, depth / 120)) and 2.5 < depth < 3.1
    fixed = dataclasses.replace(CONFIG, fusion=FusionConfig(voxel_low=0.2, voxel_high=0.05))
    assert run(fixed, count=1)[0].volumes.voxel_lengths() == (0.2, 0.05)


def test_the_map_unit_does_not_matter():
    (_, metres), (_, tiny) = (run(unit=unit)[0].surfaces() for unit in (1.0, 0.01))
    assert len(tiny.triangles) == pytest.approx(len(metres.triangles), rel=0.02)
    assert np.median(np.abs(tiny.vertices_world @ NORMAL_WORLD - 0.01 * OFFSET)) < 0.01 * 0.006


def test_two_runs_are_equal():
    one, other = (run(count=2)[0].surfaces()[1] for _ in range(2))
    np.testing.assert_array_equal(one.vertices_world, other.vertices_world)
    np.testing.assert_array_equal(one.triangles, other.triangles)


def test_a_keyframe_and_its_view_do_not_wait_for_ever():
    densification, consistency = DensificationConfig(max_wait_s=1.0, keyframe_stride=1), ConsistencyConfig(max_wait_s=1.5)
    config = dataclasses.replace(CONFIG, densification=densification, consistency=consistency)
    reconstruction, one = Reconstruction(reference.SMALL, config), next(snapshots())
    second, start = 1_000_000_000, one.frame.timestamp_ns
    densifying, meshing = reconstruction.densifying, reconstruction.meshing
    assert list(densifying.push(one)) == [] == list(densifying.expire(start + second))
    (denser,) = densifying.expire(start + second + 1)
    assert list(meshing.push(denser)) == [] == list(meshing.expire(start + 3 * second // 2))
    assert [view.timestamp_ns for view in meshing.expire(start + 2 * second)] == [start]
    assert list(densifying.flush()) == [] == list(meshing.flush())
