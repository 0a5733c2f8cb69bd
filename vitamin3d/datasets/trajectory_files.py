# SPDX-License-Identifier: Apache-2.0
"""Trajectory files of any system: TUM, EuRoC's table, KITTI's poses; the format is recognised, a wrong name refused."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vitamin3d.datasets.tables import Row, row_seconds, rows_of
from vitamin3d.datasets.trajectories import read_euroc_states, read_kitti_poses, read_tum
from vitamin3d.errors import InputError
from vitamin3d.types import Trajectory

FORMATS = ("tum", "euroc", "kitti")
DESCRIPTIONS = {
    "tum": "TUM (`t tx ty tz qx qy qz qw`, seconds or nanoseconds)",
    "euroc": "EuRoC (`t px py pz qw qx qy qz ...`, commas, nanoseconds)",
    "kitti": "KITTI (twelve numbers of a 3×4 matrix, no time)",
}
FIRST_NANOSECONDS = 1e14
"""A TUM time above this is in nanoseconds (ORB-SLAM3 saves such files for EuRoC): 1e14 s is three million years."""


@dataclass(frozen=True)
class TrajectoryFile:
    """Poses as a file has them, to the world."""

    trajectory: Trajectory
    kind: str
    """One of `FORMATS`."""

    @property
    def is_of_body(self) -> bool:
        """True for EuRoC's table, whose poses are of the body by definition; else the file does not say."""
        return self.kind == "euroc"


def read_trajectory(path: Path, kind: str | None = None, times: Path | None = None) -> TrajectoryFile:
    """A trajectory in any of the formats.

    Args:
        kind: one of `FORMATS`, where the caller knows; None: recognised.
        times: KITTI's `times.txt`; None: the one beside the poses.

    Raises:
        InputError: not a trajectory, in another format than named, empty, or not finite.
    """
    found = format_of(path)
    if kind is not None and kind != found:
        raise InputError(f"{path}: this is {DESCRIPTIONS[found]}, not {DESCRIPTIONS[kind]}; name the right format or leave the option out")
    if found == "euroc":
        return TrajectoryFile(read_euroc_states(path, np.eye(4)), found)
    return TrajectoryFile(_read_kitti(path, times) if found == "kitti" else _read_tum(path), found)


def format_of(path: Path) -> str:
    """The format of a trajectory file by its first row; InputError where it is none."""
    row = next(rows_of(path, "one"), None)
    if row is None:
        raise InputError(f"{path}: no poses in it; give a trajectory with at least three")
    has_commas = "," in " ".join(row.fields)
    fields = [field for field in " ".join(row.fields).replace(",", " ").split() if field]
    if not all(_is_number(field) for field in fields):
        raise row.fail(f"not a trajectory, found {' '.join(row.fields)[:60]!r}; {_known()}")
    if has_commas and len(fields) >= 8 and fields[0].isdigit():
        return "euroc"
    if not has_commas and len(fields) in (8, 12):
        return "tum" if len(fields) == 8 else "kitti"
    raise row.fail(f"{len(fields)} numbers per line{' with commas' if has_commas else ''} are no trajectory that is known; {_known()}")


def _known() -> str:
    return "known are " + ", ".join(DESCRIPTIONS[kind] for kind in FORMATS)


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _read_tum(path: Path) -> Trajectory:
    read = read_tum(path, _nanoseconds) if _time(next(rows_of(path, "one"))) > FIRST_NANOSECONDS else read_tum(path)
    return read


def _time(row: Row) -> float:
    return row.numbers(row.fields[:1])[0]


def _nanoseconds(row: Row) -> int:
    """ORB-SLAM3 writes nanoseconds as `1403715273262142976.000000`."""
    whole, _, rest = row.fields[0].partition(".")
    if not whole.isdigit() or rest.strip("0") or int(whole) >= 2**63:
        raise row.fail(f"expected a time in nanoseconds as in the first line, found {row.fields[0]!r}")
    return int(whole)


def _read_kitti(path: Path, times: Path | None) -> Trajectory:
    times = times or path.parent / "times.txt"
    if not times.is_file():
        raise InputError(f"{path}: KITTI's poses have no times; give --times FILE, the sequence's times.txt")
    return read_kitti_poses(path, [row_seconds(row) for row in rows_of(times, "seconds")])
