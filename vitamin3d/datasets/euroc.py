# SPDX-License-Identifier: Apache-2.0
"""EuRoC's ASL folders: `mav0/cam0/{data.csv,sensor.yaml,data/}` and `mav0/state_groundtruth_estimate0/data.csv`."""

from pathlib import Path

from vitamin3d.datasets.base import Listing, PictureSequence
from vitamin3d.datasets.calibration import missing_calibration, read_calibration
from vitamin3d.datasets.tables import check_ascending, row_nanoseconds, rows_of
from vitamin3d.datasets.trajectories import read_euroc_states
from vitamin3d.errors import InputError
from vitamin3d.types import Array, Trajectory


def camera_folder(source: Path) -> Path | None:
    """`cam0` of a sequence's root, of its `mav0`, or the folder itself; None where it is none of these."""
    for folder in (source / "mav0" / "cam0", source / "cam0", source):
        if (folder / "data.csv").is_file() and ((folder / "data").is_dir() or (folder / "sensor.yaml").is_file()):
            return folder
        if folder != source and folder.is_dir():
            return folder
    return None


class EurocDataset(PictureSequence):
    """The left camera of a EuRoC sequence."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        folder = camera_folder(source) or source
        self._sensor, self._override = folder / "sensor.yaml", calibration
        self._states = folder.resolve().parent / "state_groundtruth_estimate0" / "data.csv"
        if calibration is None and not self._sensor.is_file():
            raise missing_calibration(folder)
        camera = read_calibration(calibration or self._sensor).camera
        super().__init__(source, camera, _listing(folder))
        self.name = _sequence_name(folder)

    def ground_truth(self) -> Trajectory | None:
        """Poses of the CAMERA, not of the body: T_world_cam = T_world_body @ T_BS of cam0's `sensor.yaml`."""
        return read_euroc_states(self._states, self._body_from_camera()) if self._states.is_file() else None

    def _body_from_camera(self) -> Array:
        for path in (self._sensor, self._override):
            T_body_cam = read_calibration(path).T_body_cam if path is not None and path.is_file() else None
            if T_body_cam is not None:
                return T_body_cam
        raise InputError(f"{self._sensor}: no `T_BS`, so the ground truth (of the body) cannot be moved into the camera; add it")


def _listing(folder: Path) -> Listing:
    rows = list(rows_of(folder / "data.csv", "timestamp_ns filename", ","))
    timestamps_ns = [row_nanoseconds(row) for row in rows]
    check_ascending(timestamps_ns, rows)
    return Listing(timestamps_ns, [folder / "data" / row.fields[1] for row in rows])


def _sequence_name(folder: Path) -> str:
    """Name of the folder above `mav0/cam0`."""
    above = [part for part in folder.resolve().parts if part not in ("mav0", "cam0")]
    return above[-1]
