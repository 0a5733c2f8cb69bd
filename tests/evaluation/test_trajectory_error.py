# SPDX-License-Identifier: Apache-2.0
"""ATE and RPE: by hand, and as evo computes them."""

import numpy as np
import pytest

from vitamin3d.errors import InputError
from vitamin3d.evaluation.trajectory_error import (
    Alignment,
    absolute_errors,
    aligned,
    matched,
    pairs_by_frames,
    pairs_by_travelled_distance,
    relative_errors,
    rotation_angles_deg,
    success_rate,
    summarize,
)
from vitamin3d.geometry.se3 import exp_se3, exp_so3
from vitamin3d.types import Trajectory

quiet = pytest.mark.filterwarnings("ignore")  # evo imports pandas, seaborn and others, each of which may warn


def walk(rng, count=60):
    """A random walk: steps of about 0.1 forward and 3 degrees."""
    poses = [exp_se3(rng.standard_normal(6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp_se3(np.concatenate([[0.0, 0.0, 0.1] + 0.02 * rng.standard_normal(3), 0.05 * rng.standard_normal(3)])))
    return Trajectory(np.arange(count) * 50_000_000, np.array(poses))


def estimate_of(truth, rng, noise=0.02):
    """The truth in another world and unit, with noise on each pose."""
    world, scale = exp_se3(rng.standard_normal(6)), 0.4
    poses = [world @ pose @ exp_se3(noise * rng.standard_normal(6)) for pose in truth.T_world_cam]
    for pose in poses:
        pose[:3, 3] *= scale
    return Trajectory(truth.timestamps_ns, np.array(poses))


def line(xs):
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    return Trajectory(np.arange(len(xs)) * 10**8, poses)


def evo_path(trajectory):
    return pytest.importorskip("evo.core.trajectory").PosePath3D(poses_se3=list(np.array(trajectory.T_world_cam)))


EVO_ALIGN = {
    Alignment.NONE: lambda estimate, truth: None,
    Alignment.SIM3: lambda estimate, truth: estimate.align(truth, correct_scale=True),
    Alignment.SE3: lambda estimate, truth: estimate.align(truth),
    Alignment.SCALE: lambda estimate, truth: (estimate.align(truth, correct_only_scale=True), estimate.align_origin(truth)),
}


@quiet
@pytest.mark.parametrize("alignment", Alignment)
@pytest.mark.parametrize("seed", range(5))
def test_ate_is_that_of_evo(alignment, seed):
    metrics = pytest.importorskip("evo.core.metrics")
    rng = np.random.default_rng(seed)
    truth = walk(rng)
    estimate = estimate_of(truth, rng)
    path, reference = evo_path(estimate), evo_path(truth)
    EVO_ALIGN[alignment](path, reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    np.testing.assert_allclose(absolute_errors(estimate, truth, alignment), ape.error, atol=1e-6)
    ours, theirs = summarize(absolute_errors(estimate, truth, alignment)), ape.get_all_statistics()
    assert (ours.rmse, ours.median, ours.maximum) == pytest.approx((theirs["rmse"], theirs["median"], theirs["max"]), abs=1e-6)


@quiet
@pytest.mark.parametrize(("unit", "delta"), [("frames", 1), ("frames", 10), ("meters", 0.5), ("meters", 2.0)])
@pytest.mark.parametrize("seed", range(3))
def test_rpe_is_that_of_evo(unit, delta, seed):
    metrics = pytest.importorskip("evo.core.metrics")
    rng = np.random.default_rng(seed)
    truth = walk(rng)
    estimate = aligned(estimate_of(truth, rng), truth, Alignment.SIM3)
    positions, frames = truth.T_world_cam[:, :3, 3], np.arange(len(truth))
    pairs = pairs_by_frames(frames, delta) if unit == "frames" else pairs_by_travelled_distance(positions, delta)
    for relation, errors in zip(("translation_part", "rotation_angle_deg"), relative_errors(estimate, truth, pairs), strict=True):
        rpe = metrics.RPE(metrics.PoseRelation[relation], delta, metrics.Unit[unit], all_pairs=True, pairs_from_reference=True)
        rpe.process_data((evo_path(truth), evo_path(estimate)))
        assert len(errors) > 10
        np.testing.assert_allclose(errors, rpe.error, atol=1e-6)


def test_a_similar_trajectory_has_no_error_after_sim3_only(rng):
    truth = walk(rng)
    estimate = estimate_of(truth, rng, noise=0.0)
    assert summarize(absolute_errors(estimate, truth, Alignment.SIM3)).maximum < 1e-12
    assert summarize(absolute_errors(estimate, truth, Alignment.SE3)).rmse > 0.1
    np.testing.assert_allclose(aligned(estimate, truth, Alignment.SIM3).T_world_cam, truth.T_world_cam, atol=1e-12)


def test_from_the_first_pose_a_wrong_first_turn_counts(rng):
    truth = walk(rng)
    poses = np.array(truth.T_world_cam)
    poses[0, :3, :3] = poses[0, :3, :3] @ exp_so3(np.array([0.0, 0.1, 0.0]))
    turned = Trajectory(truth.timestamps_ns, poses)
    assert summarize(absolute_errors(turned, truth, Alignment.SIM3)).maximum < 1e-12
    errors = absolute_errors(turned, truth, Alignment.SCALE)
    assert errors[0] < 1e-12 and errors.max() > 0.05


def test_relative_errors_by_hand():
    truth, estimate = line([0.0, 1.0, 2.0, 3.0]), line([0.0, 1.0, 2.5, 3.5])
    pairs = pairs_by_frames(np.arange(4), 1)
    assert pairs.tolist() == [[0, 1], [1, 2], [2, 3]]
    lengths, degrees = relative_errors(estimate, truth, pairs)
    np.testing.assert_allclose(lengths, [0.0, 0.5, 0.0], atol=1e-15)
    np.testing.assert_allclose(degrees, 0.0)


def test_frames_that_are_missing_are_not_jumped_over():
    assert pairs_by_frames(np.array([3, 4, 7, 8, 9]), 1).tolist() == [[0, 1], [2, 3], [3, 4]]
    assert pairs_by_frames(np.array([3, 4, 7, 8, 9]), 4).tolist() == [[0, 2], [1, 3]]
    assert pairs_by_frames(np.array([5]), 1).shape == (0, 2)


def test_distances_are_travelled_not_flown():
    there_and_back = line([0.0, 1.0, 2.0, 1.0, 0.0]).T_world_cam[:, :3, 3]
    assert pairs_by_travelled_distance(there_and_back, 2.0).tolist() == [[0, 2], [1, 3], [2, 4]]
    assert pairs_by_travelled_distance(there_and_back, 1.5).shape == (0, 2)
    assert pairs_by_travelled_distance(there_and_back[:1], 1.0).shape == (0, 2)


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-4, 1.0, 90.0, 179.0])
def test_angles_are_exact_for_small_ones(degrees, rng):
    axis = rng.standard_normal(3)
    rotation = exp_so3(np.radians(degrees) * axis / np.linalg.norm(axis))
    assert rotation_angles_deg(rotation[None])[0] == pytest.approx(degrees, rel=1e-6, abs=1e-13)


def test_poses_are_matched_by_time(rng):
    truth = walk(rng, 10)
    late = Trajectory(truth.timestamps_ns[4:8] + 3_000_000, truth.T_world_cam[4:8])
    a, b = matched(late, truth)
    assert b.timestamps_ns.tolist() == truth.timestamps_ns[4:8].tolist()
    np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)
    assert len(matched(late, truth, 1_000_000)[0]) == 0


def test_summaries_and_rates():
    summary = summarize(np.array([3.0, 4.0, 0.0]))
    assert (summary.rmse, summary.median, summary.maximum, summary.count) == (pytest.approx(np.sqrt(25 / 3)), 3.0, 4.0, 3)
    assert np.isnan(summarize(np.zeros(0)).rmse)
    assert (success_rate(3, 4), success_rate(0, 0)) == (0.75, 0.0)


def test_two_poses_cannot_be_aligned(rng):
    truth = walk(rng, 2)
    with pytest.raises(InputError, match="three pairs"):
        absolute_errors(truth, truth, Alignment.SIM3)
