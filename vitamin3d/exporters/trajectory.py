# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the TUM format, which every evaluation tool reads."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from vitamin3d.errors import OutputError
from vitamin3d.exporters.files import write_file
from vitamin3d.geometry.se3 import quaternion_xyzw
from vitamin3d.timestamps import seconds_from_nanoseconds
from vitamin3d.types import Array, Trajectory


def write_tum(trajectory: Trajectory, path: Path, comments: Sequence[str] = ()) -> None:
    """Writes `seconds tx ty tz qx qy qz qw` per pose: camera to world, map units, times exact to the nanosecond.

    The file appears whole or not at all. `comments` come first, each line behind a `#`.
    """
    if not np.isfinite(trajectory.T_world_cam).all():
        raise OutputError(f"{path}: the trajectory holds poses that are not finite; nothing written")
    write_file(path, (f"{line}\n".encode() for line in _lines(trajectory, comments)))


def _lines(trajectory: Trajectory, comments: Sequence[str]) -> Iterator[str]:
    for comment in comments:
        for line in comment.splitlines():
            yield f"# {line}".rstrip()
    for timestamp_ns, T_world_cam in zip(trajectory.timestamps_ns.tolist(), trajectory.T_world_cam, strict=True):
        yield f"{seconds_from_nanoseconds(timestamp_ns)} {_numbers(T_world_cam)}"


def _numbers(T_world_cam: Array) -> str:
    values = np.concatenate([T_world_cam[:3, 3], quaternion_xyzw(T_world_cam[:3, :3])])
    return " ".join(f"{value:.9f}" for value in np.round(values, 9) + 0.0)
