# SPDX-License-Identifier: Apache-2.0
"""The dense halves of a run's maps, and their files."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any

from vitamin3d.config import Config
from vitamin3d.dense.stages import staged
from vitamin3d.exporters.output_folder import MapFolder
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.landmark_statistics import point_cloud
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.runtime import DENSE_NICENESS, READ_AHEAD
from vitamin3d.scale import Scale
from vitamin3d.slam import Slam
from vitamin3d.types import DepthView, MapSnapshot, NewestFrame, StepTimes, Trajectory
from vitamin3d.workers import Clock, Closable, Items, ReadAhead, step

VOXEL_LOW_M, VOXEL_HIGH_M = 0.15, 0.025
"""Table 3 of the paper; the defaults where the scale is known."""
Message = MapSnapshot | NewestFrame


class MapOutput:
    """The dense half of one map, and its files; open3d is loaded when the first keyframe comes.

    Args:
        times: of the steps, shared by all maps.
        num_keyframes: of the finished map; 0: they come while the camera is tracked, and views are kept to be moved.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        folder: MapFolder,
        scale: Scale,
        times: StepTimes,
        clock: Clock | None = None,
        num_keyframes: int = 0,
    ) -> None:
        self.camera, self.config, self.folder, self.scale = camera, config, folder, scale
        self.times, self.clock, self.num_keyframes = times, clock, num_keyframes
        self.reconstruction: Reconstruction | None = None
        self.num_moved = 0
        """Views that were fused anew because their keyframe had moved."""
        self.empty_meshes = ["mesh_low", "mesh_high"]
        """Names of those that have no triangle; they are not written."""
        self.cloud_points = 0
        self.mesh_lags: list[float] = []
        """Seconds from when a keyframe's picture was due until it was in the volume; where there is a clock."""
        self.mesh_begins: float | None = None
        """The same of the first keyframe; it, and those fused together with it, had to wait for the choice of the voxels."""

    def begun(self) -> Reconstruction:
        """The dense half, begun now where it was not yet."""
        if self.reconstruction is None:
            config, is_live = with_voxels(self.config, self.scale), self.num_keyframes == 0
            self.reconstruction = Reconstruction(self.camera, config, self.times, keeps_views=is_live, num_keyframes=self.num_keyframes)
            self.folder.write_canvas(self.reconstruction.canvas, self.scale)
        return self.reconstruction

    def add(self, snapshot: MapSnapshot) -> None:
        """Takes a keyframe; fuses those that are ready and writes their maps."""
        for view in self.begun().add_keyframe(snapshot):
            self.folder.write_view(view, self.scale)

    def fuse(self, view: DepthView) -> None:
        """Fuses a view and writes its maps."""
        with step(f"fusing the view of {view.timestamp_ns / 1e9:.3f} s"):
            fused = self.begun().volumes.fuse(view)
        self.note_lags(fused)
        with step("writing depth and normal maps"):
            self.folder.write_view(view, self.scale)

    def note_lags(self, fused: list[DepthView]) -> None:
        """How late views came into the volume; where there is a clock."""
        if self.clock is None or not fused:
            return
        lags = [self.clock.seconds_since(view.timestamp_ns) for view in fused]
        if self.mesh_begins is None:
            self.mesh_begins = max(lags)
        else:
            self.mesh_lags += lags

    def finish(self) -> None:
        """Fuses the keyframes that wait for neighbours."""
        if self.reconstruction is not None:
            with step("meshing and fusing the last keyframes"):
                for view in self.reconstruction.finish():
                    self.folder.write_view(view, self.scale)

    def fuse_again(self, trajectory: Trajectory) -> None:
        """Moves the fused views of keyframes that moved afterwards."""
        if self.reconstruction is not None and self.reconstruction.volumes.store is not None:
            poses = inverse(trajectory.T_world_cam)
            with step("fusing keyframes anew that moved"):
                self.num_moved = self.reconstruction.fuse_again(dict(zip(trajectory.timestamps_ns.tolist(), poses, strict=True)))

    def write_sparse(self, slam: Slam) -> None:
        """Trajectories, calibration and cloud."""
        config = self.config.cloud
        cloud = point_cloud(slam.map, slam.camera, config, self.config.snapshot)
        remark = (
            f"landmarks with at least {config.min_observations} observations, parallax from {config.min_parallax_deg} degrees, "
            f"reprojection RMS up to {config.max_reprojection_rms_px} px"
        )
        self.folder.write_trajectories(slam.trajectory(), slam.keyframe_trajectory(), self.scale)
        self.folder.write_calibration(slam.camera, "as given" if slam.camera == slam.mapper.calibration.given else "refined with the map")
        self.folder.write_cloud(cloud, self.scale, remark)
        self.cloud_points = len(cloud.points_world)

    def write_surfaces(self, is_broken: bool = False) -> None:
        """Writes the meshes, without the keyframes that still wait where a step is broken."""
        dense = self.reconstruction
        if dense is None:
            return
        if is_broken:
            dense.chain.clear()
        if dense.volumes.median_depths:
            remark = dense.volumes.filter_remark
            self.empty_meshes = self.folder.write_surfaces(*dense.surfaces(), self.scale, dense.volumes.voxel_lengths(), remark)

    def voxels(self) -> dict[str, float] | None:
        """Sides of the voxels in the unit of the output."""
        if self.reconstruction is None or not self.reconstruction.volumes.median_depths:
            return None
        low, high = self.reconstruction.volumes.voxel_lengths()
        return {"low": low * self.scale.metres_per_unit, "high": high * self.scale.metres_per_unit}

    def volumes(self) -> dict[str, Any] | None:
        """Blocks and megabytes of the volumes where they are known, and what was kept and moved of the views."""
        dense = None if self.reconstruction is None else self.reconstruction.volumes
        if dense is None or dense.low is None or dense.high is None:
            return None
        table: dict[str, Any] = {name: _megabytes(volume.size()) for name, volume in (("low", dense.low), ("high", dense.high))}
        if dense.store is None:
            return table
        store = dense.store
        kept = {"temporary_megabytes": round(store.num_bytes / 1e6, 1), "views_forgotten": store.num_forgotten}
        return table | {"refusion": kept | {"views_moved": self.num_moved, "failure": store.failure or None}}


class MapOutputs:
    """Hands the keyframes of a run to their maps' dense halves; where another map's come, those of the one before wait no longer.

    Args:
        begin: makes the output of a map, by its number, when its first keyframe comes.
    """

    def __init__(self, begin: Callable[[int], MapOutput], threads: bool, is_live: bool) -> None:
        self._begin, self._threads, self._is_live = begin, threads, is_live
        self.by_number: dict[int, MapOutput] = {}
        """In the order in which they began."""
        self._newest: MapOutput | None = None

    def of(self, number: int) -> MapOutput:
        """The output of a map, by its number."""
        if number not in self.by_number:
            self.by_number[number] = self._begin(number)
        return self.by_number[number]

    def add(self, snapshot: MapSnapshot) -> None:
        """Takes a keyframe; fuses those that are ready and writes their maps."""
        here, before = self.of(snapshot.map_number), self._newest
        self._newest = here
        if before is not None and before is not here:
            before.finish()
        here.add(snapshot)

    def add_all(self, snapshots: Iterable[Message], done: Callable[[MapOutput, DepthView], None] | None = None) -> None:
        """All keyframes that come; densified ahead of meshing, meshed ahead of the fusion."""
        with ExitStack() as threads:
            waited_for = snapshots if isinstance(snapshots, Items) else None
            densified = staged(snapshots, lambda number: self.of(number).begun().densifying)
            ready = self._beside(threads, "densification", densified, waited_for)
            views = staged(ready, lambda number: self.of(number).begun().meshing)
            meshed = self._beside(threads, "meshing", views, ready if isinstance(ready, ReadAhead) else None)
            for view in (view for view in meshed if isinstance(view, DepthView)):
                output = self.of(view.map_number)
                output.fuse(view)
                if done is not None:
                    done(output, view)

    def finish(self) -> None:
        """Fuses the keyframes that wait for neighbours."""
        for output in self.by_number.values():
            output.finish()

    def _beside(self, threads: ExitStack, name: str, source: Iterator[Any], upstream: Closable | None) -> Iterable[Any]:
        """The items of a generator, computed on a thread of its own where there are any; in live runs just one ahead."""
        source = _named(name, source)
        if not self._threads:
            return source
        size, niceness = (1, DENSE_NICENESS) if self._is_live else (READ_AHEAD, 0)
        return threads.enter_context(ReadAhead(source, name, size, niceness, upstream))


def _named(name: str, source: Iterator[Any]) -> Iterator[Any]:
    """The items of a generator, whose failure names the step."""
    with step(name):
        yield from source


def _megabytes(size: dict[str, int] | None) -> dict[str, float] | None:
    return None if size is None else {"blocks": size["blocks"], "megabytes": round(size["bytes"] / 1e6, 1)}


def with_voxels(config: Config, scale: Scale) -> Config:
    """The settings with voxel sizes in map units: the paper's metres where the scale is known."""
    if not scale.is_known:
        return config
    low, high = config.fusion.voxel_low or VOXEL_LOW_M, config.fusion.voxel_high or VOXEL_HIGH_M
    fusion = dataclasses.replace(config.fusion, voxel_low=scale.units(low), voxel_high=scale.units(high))
    return dataclasses.replace(config, fusion=fusion)
