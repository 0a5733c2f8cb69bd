# SPDX-License-Identifier: Apache-2.0
"""Of which frame of the rig a ground truth is: the body or the camera, told by how it turns.

EuRoC's truth is of the body (the IMU), files made from it are of one or the other and do not say so. A perfect trajectory of the
camera scored against the body misses by the length of T_BS times what the rig turned: 3 to 6 cm for EuRoC.

Rotations tell: between two moments the body turns by `R_BC D R_BC^T` when the camera turns by `D`, whatever world and
scale the trajectories are in. Where nothing turns, two trajectories of one world are told apart by where they are.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from vitamin3d.errors import InputError
from vitamin3d.evaluation.trajectory_error import Alignment, aligned, orientation_errors_deg, position_errors, rotation_angles_deg
from vitamin3d.geometry.se3 import inverse, quaternion_xyzw, rotation_from_quaternion
from vitamin3d.types import Array, Trajectory

MAX_PAIRS = 400
"""Motions that are compared."""
LEAST_TURN_DEG = 2.0
"""RMS of the compared turns below which rotations tell nothing."""
LEAST_PATH = 0.05
"""RMS distance of the true positions from their mean, metres, below which no similarity can be fitted."""
LEAST_SPREAD = 1e-9
"""The same, below which the positions are one."""
UNRELATED, CLEARLY = 0.5, 0.5
"""Relative residual above which turns have nothing in common, and by which a better explanation must be better."""
SAME_WORLD_DEG = 5.0


class TruthFrame(Enum):
    """What a ground truth is said or found to be of."""

    CAMERA = "camera"
    BODY = "body"


@dataclass(frozen=True)
class FrameFinding:
    """Which frame a ground truth is of, and what it would cost to take it as it is."""

    frame: TruthFrame
    """Of the truth as it was given, relative to the estimate."""
    is_certain: bool
    """False: nothing moved that could tell, and the declaration stands."""
    remark: str
    """For people."""
    uncorrected_rmse: float | None = None
    """RMSE of the positions against the truth as it is, after the same alignment; None where nothing was corrected."""
    uncorrected_deg: float | None = None
    """RMS angle between the orientations, likewise."""


def turns(trajectory: Trajectory, pairs: Array) -> Array:
    """Rotation vectors (P, 3), radians, of the camera's turn from one row to another."""
    R = trajectory.T_world_cam[:, :3, :3]
    return np.asarray(Rotation.from_matrix(R[pairs[:, 0]].transpose(0, 2, 1) @ R[pairs[:, 1]]).as_rotvec())


def spread_pairs(count: int) -> Array:
    """Rows (P, 2), at most `MAX_PAIRS`, a tenth of the trajectory apart."""
    gap = max(1, count // 10)
    first = np.unique(np.linspace(0, count - 1 - gap, min(MAX_PAIRS, max(1, count - gap))).astype(int))
    return np.stack([first, first + gap], axis=1)


def residual(estimated: Array, true: Array, R_true_est: Array) -> float:
    """RMS difference of turns (P, 3) after a change of frame, relative to their RMS: 0 the same, 1.4 unrelated."""
    return float(np.sqrt(((true - estimated @ R_true_est.T) ** 2).sum() / max(1e-18, (true**2).sum())))


def check_quaternion_order(estimate: Trajectory, truth: Trajectory, T_body_cam: Array | None, names: tuple[str, str]) -> None:
    """InputError where the estimate's turns are not the truth's, but are when the quaternions of either are read with w first.

    Args:
        estimate, truth: paired by row.
        T_body_cam: (4, 4), where it is known: either may be of the body.
        names: of the files with the estimate and the truth.
    """
    pairs = spread_pairs(len(estimate))
    true = turns(truth, pairs)
    if _rms_deg(true) < LEAST_TURN_DEG:
        return
    R = np.eye(3) if T_body_cam is None else T_body_cam[:3, :3]

    def misfit(a: Trajectory, b: Trajectory) -> float:
        turned, expected = turns(a, pairs), turns(b, pairs)
        return min(residual(turned, expected, F) for F in (np.eye(3), R, R.T))

    if misfit(estimate, truth) <= UNRELATED:
        return
    swapped = (misfit(_with_w_first(estimate), truth), misfit(estimate, _with_w_first(truth)))
    if min(swapped) < CLEARLY * UNRELATED:
        name = names[int(np.argmin(swapped))]
        raise InputError(f"{name}: the quaternions are in the order w x y z; TUM has x y z w: swap the columns")


def _with_w_first(trajectory: Trajectory) -> Trajectory:
    """The poses, had the file's quaternion columns x y z w been w x y z."""
    poses = np.array(trajectory.T_world_cam)
    for pose in poses:
        x, y, z, w = quaternion_xyzw(pose[:3, :3])
        pose[:3, :3] = rotation_from_quaternion(np.array([y, z, w, x]))
    return Trajectory(trajectory.timestamps_ns, poses)


def _best_residual(estimated: Array, true: Array) -> float:
    """Residual of the turns after the best fixed rotation between the two rigs (Kabsch)."""
    U, _, Vt = np.linalg.svd(true.T @ estimated)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return residual(estimated, true, R)


def moved_into_camera(truth: Trajectory, T_body_cam: Array) -> Trajectory:
    """A truth of the body as one of the camera: `T_world_cam = T_world_body T_body_cam`."""
    return Trajectory(truth.timestamps_ns, truth.T_world_cam @ T_body_cam)


def recognise_frame(estimate: Trajectory, truth: Trajectory, T_body_cam: Array | None, declared: TruthFrame | None) -> FrameFinding:
    """Of which frame a truth is, given an estimate of the camera, or of the same frame as the truth.

    Args:
        estimate: of the camera; one of the body is recognised and compared with the body.
        truth: as the file has it, paired by row with the estimate.
        T_body_cam: (4, 4) of the calibration; None: not known.
        declared: what the format or the user says; None: nothing. Only the user says CAMERA, and is believed.

    Raises:
        InputError: the truth is of the body, and T_body_cam is not known.
    """
    if T_body_cam is None:
        return _without_extrinsics(estimate, truth, declared)
    if np.allclose(T_body_cam, np.eye(4), atol=1e-9):
        return FrameFinding(declared or TruthFrame.CAMERA, True, "the body and the camera are the same (T_BS is the identity)")
    in_camera = moved_into_camera(truth, T_body_cam)
    as_is, moved = (_misfit(estimate, candidate) for candidate in (truth, in_camera))
    certain = max(as_is, moved) > 0 and min(as_is, moved) < CLEARLY * max(as_is, moved)
    is_body = moved < as_is if certain else declared is TruthFrame.BODY
    if is_body and certain and declared is TruthFrame.CAMERA:
        return FrameFinding(
            TruthFrame.CAMERA, True, "warning: said to be of the camera and taken as it is, but the truth turns as the body does"
        )
    if not is_body and declared is TruthFrame.BODY:
        remark = "the truth is said to be of the body, but it and the estimate are of one frame: not moved"
        return FrameFinding(TruthFrame.CAMERA, certain, remark)
    if not is_body:
        return FrameFinding(TruthFrame.CAMERA, certain, f"the truth is {'' if certain else 'taken to be '}of the camera")
    how = "" if declared else " (recognised by how it turns and where it is)"
    remark = f"the truth is of the body; moved into the camera by T_BS{how}"
    return FrameFinding(TruthFrame.BODY, certain, remark, *_as_it_is(estimate, truth))


def _without_extrinsics(estimate: Trajectory, truth: Trajectory, declared: TruthFrame | None) -> FrameFinding:
    pairs = spread_pairs(len(estimate))
    estimated, true = turns(estimate, pairs), turns(truth, pairs)
    turning = _rms_deg(true) >= LEAST_TURN_DEG
    as_is, best = residual(estimated, true, np.eye(3)), _best_residual(estimated, true)
    is_same = turning and as_is < UNRELATED and best > CLEARLY * as_is
    if declared is TruthFrame.BODY and not is_same and not (turning and as_is < 0.05):
        raise InputError(
            "the ground truth is of the body, and no T_BS is known to move it into the camera; "
            "give --source or --calibration with T_BS, or --truth-frame camera to compare them as they are"
        )
    if turning and as_is > UNRELATED and best < CLEARLY * as_is:
        remark = "warning: the truth turns about other axes than the estimate: it is of another frame (the body?); give T_BS by --source"
        return FrameFinding(TruthFrame.CAMERA, False, remark)
    how = ", and turns as it does" if turning else ""
    return FrameFinding(TruthFrame.CAMERA, turning, f"the truth is taken to be of the camera{how}")


def _misfit(estimate: Trajectory, truth: Trajectory) -> float:
    """How badly two trajectories, paired by row, can be of one frame; 0 for a perfect pair."""
    pairs = spread_pairs(len(estimate))
    true = turns(truth, pairs)
    if _rms_deg(true) >= LEAST_TURN_DEG:
        return residual(turns(estimate, pairs), true, np.eye(3))
    difference = inverse(estimate.T_world_cam) @ truth.T_world_cam
    degrees = rotation_angles_deg(difference[:, :3, :3])
    return float(np.sqrt((np.radians(degrees) ** 2).mean()) + np.sqrt((difference[:, :3, 3] ** 2).sum(axis=1).mean()))


def _rms_deg(rotation_vectors: Array) -> float:
    return float(np.degrees(np.sqrt((rotation_vectors**2).sum(axis=1).mean()))) if len(rotation_vectors) else 0.0


def can_be_aligned(estimate: Trajectory, truth: Trajectory) -> bool:
    """False where the camera hardly moved, so that a similarity would be fitted to noise."""
    return spread(truth) >= LEAST_PATH and spread(estimate) > LEAST_SPREAD


def spread(trajectory: Trajectory) -> float:
    """RMS distance of the positions from their mean."""
    return float(np.sqrt(trajectory.T_world_cam[:, :3, 3].var(axis=0).sum()))


def _as_it_is(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """RMSE of the positions and RMS angle of the orientations, aligned where that can be."""
    placed = aligned(estimate, truth, Alignment.SIM3 if can_be_aligned(estimate, truth) else Alignment.NONE)
    lengths, degrees = np.linalg.norm(position_errors(placed, truth), axis=1), orientation_errors_deg(placed, truth)
    return float(np.sqrt((lengths**2).mean())), float(np.sqrt((degrees**2).mean()))
