# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM folders in their TUM-compatible form: `rgb/N.png`, `depth/N.png`, `associations.txt`, `*.gt.freiburg`."""

from fractions import Fraction
from pathlib import Path

import numpy as np

from vitamin3d.datasets.base import Listing, PictureSequence
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.image_folder import pictures_in
from vitamin3d.datasets.tables import regular_timestamps, rows_of
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.types import Trajectory

NOMINAL = PinholeCamera(481.2, 480.0, 319.5, 239.5, 640, 480)
RATE_HZ = Fraction(30)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""The data's camera has fy = -480, y up: a left-handed frame. Ours has y down; the truth is mirrored to match."""


class IclNuimDataset(PictureSequence):
    """A trajectory through the living room or the office; 30 pictures per second."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        self._source = source
        paths = pictures_in(source / "rgb")
        camera = NOMINAL if calibration is None else read_calibration(calibration).camera
        super().__init__(source, camera, Listing(regular_timestamps(len(paths), RATE_HZ), paths))

    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses in metres; the file counts pictures from 1 where its pictures are named from 0 or 1."""
        path = next(iter(sorted(self._source.glob("*.gt.freiburg"))), None)
        if path is None:
            return None
        names = {int(p.stem): k for k, p in enumerate(self._paths) if p.stem.isdigit()}
        truth, rows = read_tum(path), [int(float(row.fields[0])) for row in rows_of(path, "t")]
        known = [(k, names[name]) for k, name in enumerate(rows) if name in names]
        index = np.array(known, np.int64).reshape(-1, 2)
        return Trajectory(self.timestamps_ns[index[:, 1]], MIRROR @ truth.T_world_cam[index[:, 0]] @ MIRROR)
