# SPDX-License-Identifier: Apache-2.0
"""The folder of a finished run, and those of its maps: names, units and comments of their files, in one place."""

import io
import json
import shutil
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.config import Config, dump_toml
from vitamin3d.errors import OutputError
from vitamin3d.exporters.depth_map import write_depth_map
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.mesh import write_cloud_ply, write_obj, write_ply
from vitamin3d.exporters.normal_map import write_normal_map
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.cameras import Camera
from vitamin3d.scale import Scale
from vitamin3d.timestamps import seconds_from_nanoseconds
from vitamin3d.types import Array, DepthView, PointCloud, Surface, Trajectory

FILES = (
    "trajectory.tum",
    "keyframes.tum",
    "cloud.ply",
    "mesh_low.ply",
    "mesh_high.ply",
    "mesh_high.obj",
    "mesh_high.mtl",
    "calibration.yaml",
    "config.toml",
    "stats.json",
    "tracks.npz",
    "report.html",
)
MAPS = "maps"
VIEWS = ("normals", "depth")
FOLDERS = (*VIEWS, "evaluation", "comparison", MAPS)
DEPTH_COUNTS_PER_METRE = 1000.0
DEPTH_COUNTS_PER_UNIT = 5000.0
PROGRAM = "vitamin3d"


def _program() -> str:
    """Name and version, where it is installed."""
    try:
        return f"{PROGRAM} {version(PROGRAM)}"
    except PackageNotFoundError:
        return PROGRAM


def _camera_yaml(camera: Camera) -> str:
    """The fields of EuRoC's `sensor.yaml`."""
    numbers = list(camera.parameters.values())
    return (
        f"camera_model: pinhole\nintrinsics: {numbers[:4]!r}\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: {numbers[4:]!r}\n"
        f"resolution: [{camera.width}, {camera.height}]\n{f'readout_s: {camera.readout_s!r}' + chr(10) if camera.readout_s else ''}"
    )


def depth_counts(scale: Scale) -> float:
    """Counts of the depth PNGs per map unit: millimetres where the scale is known, else 5000 per unit."""
    return DEPTH_COUNTS_PER_METRE * scale.metres_per_unit if scale.is_known else DEPTH_COUNTS_PER_UNIT


class MapFolder:
    """Writes the results of one map; each file is complete or absent.

    Args:
        path: is made where it does not exist.
        remark: for the comments of the files.

    Raises:
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, remark: str = "") -> None:
        self.path, self.remark = path, remark
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: not a folder that can be written ({error.strerror}); choose another with -o") from None

    def _folder(self, name: str) -> Path:
        folder = self.path / name
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror}); free the disk or choose another with -o") from None
        return folder

    @property
    def _remarks(self) -> list[str]:
        return [self.remark] if self.remark else []

    def write_trajectories(self, frames: Trajectory, keyframes: Trajectory, scale: Scale) -> None:
        """`trajectory.tum` and `keyframes.tum`, camera to world."""
        comments = [f"{PROGRAM}: camera to world, {scale.remark}", *self._remarks, "timestamp tx ty tz qx qy qz qw"]
        write_tum(scale.trajectory(frames), self.path / "trajectory.tum", comments)
        write_tum(scale.trajectory(keyframes), self.path / "keyframes.tum", comments)

    def write_cloud(self, cloud: PointCloud, scale: Scale, filter_remark: str) -> None:
        """`cloud.ply`."""
        write_cloud_ply(scale.cloud(cloud), self.path / "cloud.ply", [_program(), scale.remark, *self._remarks, filter_remark])

    def write_surfaces(self, low: Surface, high: Surface, scale: Scale, voxels: tuple[float, float], filter_remark: str = "") -> list[str]:
        """`mesh_low.ply`, `mesh_high.ply` and `mesh_high.obj`; voxels in map units.

        Returns:
            Names of those without a triangle, which are not written.
        """
        for name, surface, voxel in (("mesh_low", low, voxels[0]), ("mesh_high", high, voxels[1])):
            size = f"TSDF voxels of {voxel * scale.metres_per_unit:.6g} {scale.unit}"
            comments = [comment for comment in (_program(), scale.remark, self.remark, size, filter_remark) if comment]
            if not len(surface.triangles):
                continue
            scaled = scale.surface(surface)
            write_ply(scaled, self.path / f"{name}.ply", comments)
            if name == "mesh_high":
                write_obj(scaled, self.path / f"{name}.obj", comments)
        return [name for name, surface in (("mesh_low", low), ("mesh_high", high)) if not len(surface.triangles)]

    def write_calibration(self, camera: Camera, remark: str) -> None:
        """`calibration.yaml`: the camera that was used, for --calibration."""
        write_file(self.path / "calibration.yaml", [f"# {PROGRAM}: {remark}\n{_camera_yaml(camera)}".encode()])

    def write_canvas(self, canvas: Camera, scale: Scale) -> None:
        """`depth/canvas.yaml`: the pinhole camera of the depth and normal maps, and the unit of depth."""
        counts = DEPTH_COUNTS_PER_METRE if scale.is_known else DEPTH_COUNTS_PER_UNIT
        text = (
            "# pinhole camera of the depth and normal maps: the undistorted picture on a canvas that holds all of it\n"
            f"{_camera_yaml(canvas)}"
            f"depth_counts_per_{'metre' if scale.is_known else 'map_unit'}: {counts}\n"
        )
        write_file(self._folder("depth") / "canvas.yaml", [text.encode()])

    def write_view(self, view: DepthView, scale: Scale) -> None:
        """`depth/<timestamp>.png` and `normals/<timestamp>.png` of a keyframe."""
        name = f"{seconds_from_nanoseconds(view.timestamp_ns)}.png"
        write_depth_map(view.depth, self._folder("depth") / name, depth_counts(scale))
        write_normal_map(view.normals_cam, self._folder("normals") / name)


def _move_views(source: Path, target: Path) -> None:
    """Moves depth and normal maps by renaming their folders; the target has none."""
    target.mkdir(parents=True, exist_ok=True)
    for name in VIEWS:
        if (source / name).exists():
            (source / name).rename(target / name)


class OutputFolder(MapFolder):
    """Writes the results of one run; its files about a map are about the largest.

    Args:
        path: is made where it does not exist.
        overwrite: an earlier result in it is removed; else it is refused.

    Raises:
        OutputError: it holds a result already, or cannot be written.
    """

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        super().__init__(path)
        try:
            earlier = [name for name in (*FILES, *FOLDERS) if (path / name).exists()]
            if earlier and not overwrite:
                raise OutputError(f"{path}: already holds a result ({', '.join(earlier[:3])}); choose another folder or add --overwrite")
            write_file(path / "stats.json", [b"{}\n"])
            self._remove([*earlier, "stats.json"])
        except OSError as error:
            raise OutputError(f"{path}: not a folder that can be written ({error.strerror}); choose another with -o") from None

    def _remove(self, names: list[str]) -> None:
        for name in names:
            target = self.path / name
            if target.is_dir():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)

    def map_folder(self, number: int, remark: str = "") -> MapFolder:
        """The folder of the `number`-th map: this one of the first, `maps/2` of the second, and so on."""
        return self if number == 1 else MapFolder(self.path / MAPS / str(number), remark)

    def arrange(self, folders: list[MapFolder], numbers: list[int | None]) -> None:
        """Moves depth and normal maps from each folder into the `number`-th map's; those without a number are removed.

        Raises:
            OutputError: they cannot be moved.
        """
        try:
            parked = [(folder, self.path / MAPS / f".{n}") for n, folder in enumerate(folders)]
            for folder, park in parked:
                _move_views(folder.path, park)
            for folder in folders:
                if folder.path != self.path:
                    shutil.rmtree(folder.path)
            for (_, park), number in zip(parked, numbers, strict=True):
                if number is not None:
                    _move_views(park, self.map_folder(number).path)
                shutil.rmtree(park)
            if not any((self.path / MAPS).iterdir()):
                (self.path / MAPS).rmdir()
        except OSError as error:
            raise OutputError(f"{self.path}: its folders cannot be renamed ({error.strerror}); choose another with -o") from None

    def write_config(self, config: Config) -> None:
        write_file(self.path / "config.toml", [dump_toml(config).encode()])

    def write_stats(self, stats: dict[str, Any]) -> None:
        write_file(self.path / "stats.json", [(json.dumps(stats, indent=2) + "\n").encode()])

    def write_tracks(self, tracks: list[tuple[int, Array, Array]]) -> None:
        """`tracks.npz`: frame_index (N,), track_id (N,) and pixel (N, 2), distorted, of all tracks in all frames."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            frame_index=np.concatenate([np.full(len(ids), index, np.int64) for index, ids, _ in tracks] or [np.zeros(0, np.int64)]),
            track_id=np.concatenate([ids for _, ids, _ in tracks] or [np.zeros(0, np.int64)]),
            pixel=np.concatenate([pixels for *_, pixels in tracks] or [np.zeros((0, 2))]).astype(np.float32),
        )
        write_file(self.path / "tracks.npz", [buffer.getvalue()])
