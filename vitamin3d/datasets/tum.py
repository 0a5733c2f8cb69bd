# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D folders: `rgb.txt`, `camera.yaml`, `groundtruth.tum` or `groundtruth.txt`."""

from pathlib import Path

from vitamin3d.datasets.base import Listing, PictureSequence
from vitamin3d.datasets.calibration import missing_calibration, read_calibration
from vitamin3d.datasets.tables import check_ascending, row_seconds, rows_of
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.types import Trajectory

TRUTH_NAMES = ("groundtruth.tum", "groundtruth.txt")


class TumDataset(PictureSequence):
    """A folder whose `rgb.txt` lists times and pictures."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        self._source = source
        path = calibration or source / "camera.yaml"
        if calibration is None and not path.is_file():
            raise missing_calibration(source)
        super().__init__(source, read_calibration(path).camera, _listing(source))

    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses as the file has them, in metres."""
        return tum_truth(self._source)


def tum_truth(source: Path) -> Trajectory | None:
    """The trajectory of `groundtruth.tum` or `groundtruth.txt`, or None."""
    paths = [source / name for name in TRUTH_NAMES if (source / name).is_file()]
    return read_tum(paths[0]) if paths else None


def _listing(source: Path) -> Listing:
    rows = list(rows_of(source / "rgb.txt", "timestamp filename"))
    timestamps_ns = [row_seconds(row) for row in rows]
    check_ascending(timestamps_ns, rows)
    return Listing(timestamps_ns, [source / " ".join(row.fields[1:]) for row in rows])
