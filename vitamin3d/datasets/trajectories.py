# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: TUM, EuRoC states, KITTI poses. All come out as camera-to-world poses."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from vitamin3d.datasets.tables import Row, check_ascending, row_nanoseconds, row_seconds, rows_of
from vitamin3d.geometry.se3 import rotation_from_quaternion
from vitamin3d.types import Array, Trajectory

TUM_COLUMNS = "t tx ty tz qx qy qz qw"
EUROC_COLUMNS = "timestamp_ns px py pz qw qx qy qz"
KITTI_COLUMNS = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"


def read_tum(path: Path, time_of: Callable[[Row], int] = row_seconds) -> Trajectory:
    """A TUM trajectory, `t tx ty tz qx qy qz qw` per line, camera to world; times exact to the nanosecond.

    Args:
        time_of: nanoseconds of a row; by default its first field is in seconds.
    """
    rows = list(rows_of(path, TUM_COLUMNS))
    poses = [_pose(row, numbers[:3], numbers[3:]) for row in rows for numbers in [row.numbers(row.fields[1:8])]]
    return _trajectory([time_of(row) for row in rows], poses, rows)


def read_euroc_states(path: Path, T_body_cam: Array) -> Trajectory:
    """EuRoC's `state_groundtruth_estimate0/data.csv`, whose poses are of the body, moved into the camera.

    Args:
        path: the table; nanoseconds, position, quaternion wxyz, all of the body in the world.
        T_body_cam: (4, 4), `T_BS` of the camera's `sensor.yaml`.

    Returns:
        Poses of the camera: `T_world_cam = T_world_body @ T_body_cam`.
    """
    rows = list(rows_of(path, EUROC_COLUMNS, ","))
    poses = [_pose(row, v[:3], [*v[4:7], v[3]]) @ T_body_cam for row in rows for v in [row.numbers(row.fields[1:8])]]
    return _trajectory([row_nanoseconds(row) for row in rows], poses, rows)


def read_kitti_poses(path: Path, timestamps_ns: Sequence[int]) -> Trajectory:
    """KITTI's `poses.txt`, twelve numbers per line, of the left grey camera, one line per picture."""
    rows = list(rows_of(path, KITTI_COLUMNS))
    if len(rows) > len(timestamps_ns):
        raise rows[len(timestamps_ns)].fail(f"more poses than the {len(timestamps_ns)} times of times.txt; use the files of one sequence")
    poses = [np.vstack([np.reshape(row.numbers(row.fields[:12]), (3, 4)), [0.0, 0.0, 0.0, 1.0]]) for row in rows]
    return _trajectory(list(timestamps_ns[: len(rows)]), poses, rows)


def _pose(row: Row, position: Sequence[float], quaternion_xyzw: Sequence[float]) -> Array:
    if abs(np.linalg.norm(quaternion_xyzw) - 1.0) > 0.05:
        raise row.fail("the quaternion is not of length 1; check the order of the columns")
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(np.array(quaternion_xyzw))
    T[:3, 3] = position
    return T


def _trajectory(timestamps_ns: list[int], poses: list[Array], rows: list[Row]) -> Trajectory:
    check_ascending(timestamps_ns, rows)
    return Trajectory(np.array(timestamps_ns, np.int64), np.array(poses, np.float64).reshape(-1, 4, 4))
