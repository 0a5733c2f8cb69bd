# SPDX-License-Identifier: Apache-2.0
"""KITTI odometry folders: `image_0` (or `image_2`), `times.txt`, `calib.txt`, `poses.txt` or `groundtruth.tum`."""

from pathlib import Path

from vitamin3d.datasets.base import Listing, PictureSequence, check_count, first_picture, picture_size
from vitamin3d.datasets.calibration import missing_calibration, read_calibration, read_kitti_calibration
from vitamin3d.datasets.image_folder import pictures_in
from vitamin3d.datasets.tables import check_ascending, row_seconds, rows_of
from vitamin3d.datasets.trajectories import read_kitti_poses
from vitamin3d.datasets.tum import tum_truth
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Trajectory

PROJECTIONS = {"image_0": "P0", "image_2": "P2"}


class KittiDataset(PictureSequence):
    """The left camera of a KITTI odometry sequence, grey where it is there, else colour."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        self._source = source
        folder = next(source / name for name in PROJECTIONS if (source / name).is_dir())
        listing = _listing(source, folder)
        check_count(folder, len(listing.paths))
        super().__init__(source, _camera(folder, listing, calibration), listing)

    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses in metres, of the left grey camera."""
        folder = self._source.resolve()
        for poses in (folder / "poses.txt", folder.parents[1] / "poses" / f"{folder.name}.txt"):
            if poses.is_file():
                return read_kitti_poses(poses, self.timestamps_ns.tolist())
        return tum_truth(self._source)


def _camera(folder: Path, listing: Listing, calibration: Path | None) -> Camera:
    if calibration is not None:
        return read_calibration(calibration).camera
    path = folder.parent / "calib.txt"
    if not path.is_file():
        raise missing_calibration(folder.parent)
    return read_kitti_calibration(path, PROJECTIONS[folder.name], picture_size(first_picture(folder, tuple(listing.paths))))


def _listing(source: Path, folder: Path) -> Listing:
    rows = list(rows_of(source / "times.txt", "seconds"))
    paths = pictures_in(folder)
    if len(rows) != len(paths):
        raise InputError(f"{source / 'times.txt'}: {len(rows)} times for {len(paths)} pictures in {folder}; use the files of one sequence")
    timestamps_ns = [row_seconds(row) for row in rows]
    check_ascending(timestamps_ns, rows)
    return Listing(timestamps_ns, paths)
