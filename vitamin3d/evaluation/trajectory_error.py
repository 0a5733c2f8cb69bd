# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory is from the true one: ATE and RPE as Sturm et al. (2012) define them and evo computes them.

Both trajectories are of the CAMERA, camera to world, each in its own world. Lengths come out in the truth's unit.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from vitamin3d.geometry.se3 import inverse
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.scale import MATCH_TOLERANCE_NS, match_timestamps
from vitamin3d.types import Array, Trajectory

DISTANCE_TOLERANCE = 0.1
"""Pairs of poses for a travelled distance may miss it by this share (evo's)."""


class Alignment(Enum):
    """What is fitted before positions are compared."""

    SIM3 = "Sim(3)"
    """Scale, rotation and translation by least squares over all positions: the rule for one camera."""
    SE3 = "SE(3)"
    """Rotation and translation by least squares: the estimate's own scale counts."""
    SCALE = "scale, first pose"
    """The scale of Sim(3), then the first poses put on each other: drift from the start counts (evo's `-s --align_origin`)."""
    NONE = "no alignment"
    """Positions as they are: for two trajectories of one world, where the camera hardly moved."""


FITTED = (Alignment.SIM3, Alignment.SE3, Alignment.SCALE)
"""The alignments that need a camera that moves."""


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of one kind in three numbers; NaN where there are none."""

    rmse: float
    median: float
    maximum: float
    count: int


def summarize(errors: Array) -> ErrorSummary:
    """Root mean square, median and maximum of errors (N,) >= 0, in their unit."""
    if len(errors) == 0:
        return ErrorSummary(float("nan"), float("nan"), float("nan"), 0)
    return ErrorSummary(float(np.sqrt((errors**2).mean())), float(np.median(errors)), float(errors.max()), len(errors))


def matched(estimate: Trajectory, truth: Trajectory, tolerance_ns: int = MATCH_TOLERANCE_NS) -> tuple[Trajectory, Trajectory]:
    """The poses of both whose times agree, paired by row: to each of the estimate the nearest true one in time."""
    i, j = match_timestamps(estimate.timestamps_ns, truth.timestamps_ns, tolerance_ns)
    pairs = (estimate, i), (truth, j)
    a, b = (Trajectory(trajectory.timestamps_ns[rows], trajectory.T_world_cam[rows]) for trajectory, rows in pairs)
    return a, b


def success_rate(localised: int, frames: int) -> float:
    """Localised frames over all frames that the run was given, unreadable ones included; 0 for no frames."""
    return localised / frames if frames else 0.0


def alignment_between(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> tuple[float, Array, Array]:
    """Scale, rotation (3, 3) and translation (3,) that take the estimate's world to the truth's.

    Args:
        estimate, truth: paired by row (`matched`), at least three poses.

    Raises:
        InputError: fewer than three pairs, or an estimate that stands still.
    """
    if alignment is Alignment.NONE:
        return 1.0, np.eye(3), np.zeros(3)
    source, target = estimate.T_world_cam[:, :3, 3], truth.T_world_cam[:, :3, 3]
    s, R, t = align_sim3(source, target)
    if alignment is Alignment.SIM3:
        return s, R, t
    if alignment is Alignment.SE3:
        return 1.0, R, target.mean(axis=0) - R @ source.mean(axis=0)
    R = truth.T_world_cam[0, :3, :3] @ estimate.T_world_cam[0, :3, :3].T
    return s, R, target[0] - s * R @ source[0]


def aligned(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> Trajectory:
    """The estimate in the truth's world and, but for SE(3), unit; both paired by row."""
    s, R, t = alignment_between(estimate, truth, alignment)
    poses = np.array(estimate.T_world_cam)
    poses[:, :3, :3] = R @ poses[:, :3, :3]
    poses[:, :3, 3] = s * poses[:, :3, 3] @ R.T + t
    return Trajectory(estimate.timestamps_ns, poses)


def absolute_errors(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> Array:
    """ATE: distances (T,) between the camera centres of two trajectories, paired by row, after the alignment."""
    return np.asarray(np.linalg.norm(position_errors(aligned(estimate, truth, alignment), truth), axis=1))


def position_errors(placed: Trajectory, truth: Trajectory) -> Array:
    """Differences (T, 3) of the camera centres along the axes of the truth's world, estimate less truth, paired by row."""
    return np.asarray(placed.T_world_cam[:, :3, 3] - truth.T_world_cam[:, :3, 3])


def orientation_errors_deg(placed: Trajectory, truth: Trajectory) -> Array:
    """Angles (T,) in degrees between the orientations of two trajectories, paired by row."""
    return rotation_angles_deg(np.swapaxes(truth.T_world_cam[:, :3, :3], 1, 2) @ placed.T_world_cam[:, :3, :3])


def running_rmse(errors: Array) -> Array:
    """RMSE (T,) of the errors (T,) up to and with each (the paper's Fig. 4 over time)."""
    return np.asarray(np.sqrt(np.cumsum(errors**2) / np.arange(1, len(errors) + 1)))


def relative_errors(estimate: Trajectory, truth: Trajectory, pairs: Array) -> tuple[Array, Array]:
    """RPE: by how much the motion from one pose to another differs from the true one.

    Args:
        estimate, truth: paired by row, in one unit (`aligned` by Sim(3); rotation and translation do not matter).
        pairs: (P, 2) rows, from and to.

    Returns:
        Lengths (P,) of the translation and angles (P,) of the rotation, in degrees, of the difference of the motions.
    """
    motions = [inverse(x.T_world_cam[pairs[:, 0]]) @ x.T_world_cam[pairs[:, 1]] for x in (truth, estimate)]
    difference = inverse(motions[0]) @ motions[1]
    return np.linalg.norm(difference[:, :3, 3], axis=1), rotation_angles_deg(difference[:, :3, :3])


def rotation_angles_deg(rotations: Array) -> Array:
    """Angles (N,) in degrees of rotation matrices (N, 3, 3), exact for small ones."""
    R = rotations
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)))


def pairs_by_frames(frame_indices: Array, distance: int) -> Array:
    """Rows (P, 2) of all poses exactly `distance` frames apart; frame_indices (T,) ascending, of the poses."""
    _, first, second = np.intersect1d(frame_indices + distance, frame_indices, assume_unique=True, return_indices=True)
    return np.stack([first, second], axis=1)


def pairs_by_time(timestamps_ns: Array, interval_ns: int, tolerance_ns: int = MATCH_TOLERANCE_NS) -> Array:
    """Rows (P, 2): from each pose the one nearest to `interval_ns` later, within the tolerance; timestamps_ns (T,) ascending."""
    i, j = match_timestamps(timestamps_ns + interval_ns, timestamps_ns, tolerance_ns)
    return np.stack([i, j], axis=1)[j > i]


def pairs_by_travelled_distance(positions: Array, distance: float, tolerance: float = DISTANCE_TOLERANCE) -> Array:
    """Rows (P, 2): from each position the later one that is nearest to `distance` further along the path.

    Args:
        positions: (T, 3), those of the truth.
        distance: along the path, in the unit of the positions.
        tolerance: a pair may miss the distance by this share of it.
    """
    travelled, pairs = path_lengths(positions), []
    for i in range(len(positions) - 1):
        misses = np.abs(travelled[i + 1 :] - travelled[i] - distance)
        k = int(np.argmin(misses))
        if misses[k] <= tolerance * distance:
            pairs.append((i, i + 1 + k))
    return np.array(pairs, np.int64).reshape(-1, 2)


def path_lengths(positions: Array) -> Array:
    """Length (T,) of the path from the first position to each of (T, 3)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
