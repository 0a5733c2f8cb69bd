# SPDX-License-Identifier: Apache-2.0
"""7-Scenes folders: `frame-NNNNNN.color.png`, `.depth.png` (millimetres) and `.pose.txt` (camera to world)."""

from fractions import Fraction
from pathlib import Path

import numpy as np

from vitamin3d.datasets.base import Listing, PictureSequence
from vitamin3d.datasets.calibration import DEFAULT_RATE_HZ, read_calibration
from vitamin3d.datasets.tables import regular_timestamps, rows_of
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.types import Array, Trajectory

NOMINAL = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
"""What the authors of the data give, for colour and depth alike."""
COLOR = "frame-*.color.*"


class SevenScenesDataset(PictureSequence):
    """A sequence of 7-Scenes (`seq-01`); 30 pictures per second."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        path = calibration or source / "camera.yaml"
        read = read_calibration(path) if calibration is not None or path.is_file() else None
        self._pictures = sorted(source.glob(COLOR))
        times = regular_timestamps(len(self._pictures), (read.rate_hz if read is not None else None) or Fraction(DEFAULT_RATE_HZ))
        super().__init__(source, read.camera if read is not None else NOMINAL, Listing(times, self._pictures))
        self.name = "/".join(source.resolve().parts[-2:])

    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses in metres, of KinectFusion: of the depth camera, which the authors take for the colour camera."""
        paths = [picture.with_name(picture.name.split(".")[0] + ".pose.txt") for picture in self._pictures]
        rows = [k for k, path in enumerate(paths) if path.is_file()]
        if not rows:
            return None
        return Trajectory(self.timestamps_ns[rows], np.array([_pose(paths[k]) for k in rows]))


def _pose(path: Path) -> Array:
    rows = [row.numbers(row.fields[:4]) for row in rows_of(path, "four numbers of a")]
    pose = np.array(rows)
    if pose.shape != (4, 4) or np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 0.05:
        raise InputError(f"{path}: not a 4×4 rigid pose; use the file of the data set")
    return pose
