# SPDX-License-Identifier: Apache-2.0
"""The whole job: a sequence in, an output folder with trajectory, cloud, meshes and maps out."""

import dataclasses
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any

from vitamin3d.config import Config
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.errors import InputError
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.landmark_statistics import information_by_id, point_cloud
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.run_report import write_report
from vitamin3d.run_statistics import Stopwatch, live_table, run_statistics
from vitamin3d.runtime import DENSE_NICENESS, READ_AHEAD, Observer, RunRecord, run_live, run_sequential, run_threaded
from vitamin3d.scale import Scale, scale_from_ground_truth
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import DepthView, MapSnapshot, NewestFrame, Trajectory
from vitamin3d.warmup import warm_up
from vitamin3d.workers import Clock, Closable, Items, ReadAhead, step

VOXEL_LOW_M, VOXEL_HIGH_M = 0.15, 0.025
"""Table 3 of the paper; the defaults where the scale is known."""


@dataclass(frozen=True)
class Selection:
    """Which frames of a sequence are used."""

    start: int = 0
    max_frames: int | None = None
    stride: int = 1

    def indices(self, count: int) -> range:
        """Indices into a sequence of `count` frames; InputError where fewer than two remain."""
        stop = count if self.max_frames is None else min(count, self.start + self.stride * self.max_frames)
        chosen = range(self.start, stop, self.stride)
        if len(chosen) < 2:
            raise InputError(f"only {len(chosen)} of {count} frames are selected; two are needed: see --start, --max-frames, --stride")
        return chosen


@dataclass(frozen=True)
class Job:
    """How a sequence is to be reconstructed."""

    config: Config
    selection: Selection = Selection()
    threads: bool = True
    metric_scale: float | None = None
    """Metres per map unit, where the caller knows."""
    scale_from_truth: bool = False
    save_tracks: bool = False
    live: bool = False
    """Keyframes are fused while the camera is tracked; else after the final adjustment of the map. See `live_config`."""
    realtime: bool = False
    """Pictures come when their time stamps say; with `live` and `threads` only."""
    mesh: bool = True
    """Else the trajectory and the cloud only: no depth views, no meshes."""


@dataclass(frozen=True)
class Outcome:
    """What became of it."""

    slam: Slam
    record: RunRecord
    scale: Scale
    stats: dict[str, Any]

    @property
    def has_map(self) -> bool:
        return self.slam.map.num_keyframes > 0


def reconstruct_sequence(dataset: Dataset, job: Job, output: OutputFolder, observer: Observer) -> Outcome:
    """Runs the job and writes everything; what was reconstructed is written even where a step fails.

    Raises:
        InputError: the selection or the scale cannot be had.
        OutputError: a file cannot be written.
        WorkerError: a step failed; it names the step.
    """
    run = _JobRun(dataset, job, output, observer)
    try:
        with step("reconstruction"):
            run.reconstruct()
    except Exception as error:
        run.save_after(error)
        raise
    return run.save()


class _JobRun:
    """What a job has come to so far."""

    def __init__(self, dataset: Dataset, job: Job, output: OutputFolder, observer: Observer) -> None:
        self.watch, self.indices = Stopwatch(), job.selection.indices(len(dataset))
        _check_scale_source(dataset, job)
        self.dataset, self.job, self.output, self.observer = dataset, _with_steady_camera(job), output, observer
        config = self.job.config
        self.front_end, self.slam = FrontEnd(config), Slam(dataset.camera, config)
        self.record = RunRecord(tracks=[] if job.save_tracks else None)
        self.clock = Clock() if job.realtime else None
        self.dense = _Dense(dataset, self.job, output, Scale(job.metric_scale, "given") if job.metric_scale else Scale(), self.clock)

    def reconstruct(self) -> None:
        """Everything but the files that are written at the end."""
        if self.job.realtime:
            warm_up([self.job.config])
        source = (self.dataset, self.indices, self.front_end, self.slam)
        if self.job.live and self.job.threads:
            run_live(*source, self.dense.add_all if self.job.mesh else None, self.observer, self.record, self.clock)
        else:
            run = run_threaded if self.job.threads else run_sequential
            run(*source, self.dense.add if self.job.live and self.job.mesh else None, self.observer, self.record)
        self.dense.finish()
        with step("final adjustment"):
            self.slam.finish()
        if self.job.live and self.slam.map.num_keyframes:
            self.dense.fuse_again(self.slam.trajectory())
        if self.slam.map.num_keyframes and not self.job.live:
            self.dense.camera, self.dense.num_keyframes = self.slam.camera, self.slam.map.num_keyframes
            if self.job.scale_from_truth:
                self.dense.scale = scale_from_ground_truth(self.slam.trajectory(), self.dataset.ground_truth())
            if self.job.mesh:
                self.dense.add_all(self._snapshots(), self._keyframe_done)

    def _snapshots(self) -> Iterator[MapSnapshot]:
        """The keyframes of the finished map, their pictures read again."""
        by_id = information_by_id(self.slam.map, self.slam.camera)
        for keyframe, frame_index in enumerate(self.slam.map.frame_indices):
            frame = self.dataset.read(frame_index)
            if not isinstance(frame, Unreadable):
                yield self.slam.snapshot(keyframe, frame, by_id)

    def _keyframe_done(self, view: DepthView) -> None:
        keyframes = self.slam.map.timestamps_ns
        self.observer.keyframe_done(bisect_right(keyframes, view.timestamp_ns), len(keyframes))

    def save(self) -> Outcome:
        """Writes what is there."""
        cloud_points = _write_sparse(self.slam, self.dense.scale, self.output, self.job)
        self.dense.write_surfaces()
        return self._conclude(cloud_points)

    def save_after(self, failure: Exception) -> None:
        """Writes what can still be written; whatever fails now has the same cause, or a later one that matters less."""
        cloud_points = 0
        with suppress(Exception):
            cloud_points = _write_sparse(self.slam, self.dense.scale, self.output, self.job)
        with suppress(Exception):
            self.dense.finish()
        with suppress(Exception):
            self.dense.write_surfaces(is_broken=True)
        with suppress(Exception):
            self._conclude(cloud_points, failure)

    def _conclude(self, cloud_points: int, failure: Exception | None = None) -> Outcome:
        if self.record.tracks is not None:
            self.output.write_tracks(self.record.tracks)
        dense, scale = self.dense, self.dense.scale
        times = [self.front_end.times, self.slam.times, *([dense.reconstruction.times] if dense.reconstruction else [])]
        stats = run_statistics(self.slam, self.record, scale, cloud_points, times, self.watch)
        stats |= {"source": self.dataset.name, "mode": self.job.config.mode, "voxels": dense.voxels(), "volumes": dense.volumes()}
        stats |= {"empty_meshes": dense.empty_meshes}
        stats |= {"skipped": [_line(s) for s in self.record.skipped], "failure": str(failure) if failure else None}
        stats |= {"live": live_table(self.record, dense.mesh_lags, dense.mesh_begins) if self.job.live else None}
        self.output.write_stats(stats)
        write_report(self.output.path, self.dataset, self.slam, self.record)
        return Outcome(self.slam, self.record, scale, stats)


def _check_scale_source(dataset: Dataset, job: Job) -> None:
    """InputError where the scale is to come from a ground truth that is not there, or not there in time."""
    if job.scale_from_truth and dataset.ground_truth() is None:
        raise InputError(f"{dataset.name}: --scale-from-ground-truth, but the source has no ground truth; use --metric-scale")
    if job.realtime and not (job.live and job.threads):
        raise InputError("--realtime is a live run on threads; leave --sequential out")
    if job.scale_from_truth and job.live:
        raise InputError("--scale-from-ground-truth needs the whole trajectory before anything is fused; leave --live out")


def _with_steady_camera(job: Job) -> Job:
    """The job as it is, or without refined calibration where depth is fused before the calibration is final."""
    calibration = job.config.calibration
    if not job.live or calibration.refine == "off":
        return job
    if calibration.refine == "on":
        raise InputError("--refine-calibration on and --live exclude each other: cameras that differ would be fused; leave one out")
    config = dataclasses.replace(job.config, calibration=dataclasses.replace(calibration, refine="off"))
    return dataclasses.replace(job, config=config)


def _named(name: str, source: Iterator[Any]) -> Iterator[Any]:
    """The items of a generator, whose failure names the step."""
    with step(name):
        yield from source


def _line(skipped: Unreadable) -> str:
    return f"{skipped.path.name}: {skipped.reason}"


def _write_sparse(slam: Slam, scale: Scale, output: OutputFolder, job: Job) -> int:
    """Settings, trajectories and cloud; the number of points in the cloud."""
    output.write_config(job.config)
    if slam.map.num_keyframes == 0:
        return 0
    config = job.config.cloud
    cloud = point_cloud(slam.map, slam.camera, config, job.config.snapshot)
    remark = (
        f"landmarks with at least {config.min_observations} observations, parallax from {config.min_parallax_deg} degrees, "
        f"reprojection RMS up to {config.max_reprojection_rms_px} px"
    )
    output.write_trajectories(slam.trajectory(), slam.keyframe_trajectory(), scale)
    output.write_calibration(slam.camera, "as given" if slam.camera == slam.calibration.given else "refined with the map")
    output.write_cloud(cloud, scale, remark)
    return len(cloud.points_world)


class _Dense:
    """The dense half and its files; open3d is loaded when the first keyframe comes."""

    def __init__(self, dataset: Dataset, job: Job, output: OutputFolder, scale: Scale, clock: Clock | None) -> None:
        self.job, self.output, self.scale, self.camera, self.clock = job, output, scale, dataset.camera, clock
        self.reconstruction: Reconstruction | None = None
        self.num_keyframes = 0
        """Of the finished map; 0: they come while the camera is tracked."""
        self.num_moved = 0
        """Views that were fused anew because their keyframe had moved."""
        self.empty_meshes = ["mesh_low", "mesh_high"] if job.mesh else []
        """Names of those that were asked for and have no triangle; they are not written."""
        self.mesh_lags: list[float] = []
        """Seconds from when a keyframe's picture was due until it was in the volume; where there is a clock."""
        self.mesh_begins: float | None = None
        """The same of the first keyframe; it, and those fused together with it, had to wait for the choice of the voxels."""

    def add(self, snapshot: MapSnapshot) -> None:
        """Takes a keyframe; fuses those that are ready and writes their maps."""
        for view in self._begun().add_keyframe(snapshot):
            self.output.write_view(view, self.scale)

    def add_all(self, snapshots: Iterable[MapSnapshot | NewestFrame], done: Callable[[DepthView], None] | None = None) -> None:
        """All keyframes that come; densified ahead of meshing, meshed ahead of the fusion."""
        with ExitStack() as threads:
            waited_for = snapshots if isinstance(snapshots, Items) else None
            densified = self._beside(threads, "densification", self._densified(snapshots), waited_for)
            for view in self._beside(threads, "meshing", self._views(densified), densified if isinstance(densified, ReadAhead) else None):
                self._fuse(view)
                if done is not None:
                    done(view)

    def _fuse(self, view: DepthView) -> None:
        """Fuses a view and writes its maps."""
        with step(f"fusing the view of {view.timestamp_ns / 1e9:.3f} s"):
            fused = self._begun().fuse(view)
        self._note_lags(fused)
        with step("writing depth and normal maps"):
            self.output.write_view(view, self.scale)

    def _note_lags(self, fused: list[DepthView]) -> None:
        if self.clock is None or not fused:
            return
        lags = [self.clock.seconds_since(view.timestamp_ns) for view in fused]
        if self.mesh_begins is None:
            self.mesh_begins = max(lags)
        else:
            self.mesh_lags += lags

    def _beside(self, threads: ExitStack, name: str, source: Iterator[Any], upstream: Closable | None) -> Iterable[Any]:
        """The items of a generator, computed on a thread of its own where there are any; in live runs just one ahead."""
        source = _named(name, source)
        if not self.job.threads:
            return source
        size, niceness = (1, DENSE_NICENESS) if self.job.live else (READ_AHEAD, 0)
        return threads.enter_context(ReadAhead(source, name, size, niceness, upstream))

    def _densified(self, snapshots: Iterable[MapSnapshot | NewestFrame]) -> Iterator[MapSnapshot | NewestFrame]:
        for snapshot in snapshots:
            if isinstance(snapshot, MapSnapshot):
                yield from self._begun().densified_ready(snapshot)
            elif self.reconstruction is not None:
                yield from self.reconstruction.late_densified(snapshot.timestamp_ns)
                yield snapshot
        if self.reconstruction is not None:
            yield from self.reconstruction.last_densified()

    def _views(self, snapshots: Iterable[MapSnapshot | NewestFrame]) -> Iterator[DepthView]:
        for snapshot in snapshots:
            if isinstance(snapshot, MapSnapshot):
                yield from self._begun().drawn_ready(snapshot)
            else:
                yield from self._begun().late_drawn(snapshot.timestamp_ns)
        if self.reconstruction is not None:
            yield from self.reconstruction.last_drawn()

    def _begun(self) -> Reconstruction:
        if self.reconstruction is None:
            config = with_voxels(self.job.config, self.scale)
            self.reconstruction = Reconstruction(self.camera, config, keeps_views=self.job.live, num_keyframes=self.num_keyframes)
            self.output.write_canvas(self.reconstruction.canvas, self.scale)
        return self.reconstruction

    def finish(self) -> None:
        """Fuses the keyframes that wait for neighbours."""
        if self.reconstruction is not None:
            with step("meshing and fusing the last keyframes"):
                for view in self.reconstruction.finish():
                    self.output.write_view(view, self.scale)

    def fuse_again(self, trajectory: Trajectory) -> None:
        """Moves the fused views of keyframes that moved afterwards."""
        if self.reconstruction is not None and self.reconstruction.store is not None:
            poses = inverse(trajectory.T_world_cam)
            with step("fusing keyframes anew that moved"):
                self.num_moved = self.reconstruction.fuse_again(dict(zip(trajectory.timestamps_ns.tolist(), poses, strict=True)))

    def volumes(self) -> dict[str, Any] | None:
        """Blocks and megabytes of the volumes where they are known, and what was kept and moved of the views."""
        dense = self.reconstruction
        if dense is None or dense.low is None or dense.high is None:
            return None
        table: dict[str, Any] = {name: _megabytes(volume.size()) for name, volume in (("low", dense.low), ("high", dense.high))}
        if dense.store is None:
            return table
        store = dense.store
        kept = {"temporary_megabytes": round(store.num_bytes / 1e6, 1), "views_forgotten": store.num_forgotten}
        return table | {"refusion": kept | {"views_moved": self.num_moved, "failure": store.failure or None}}

    def write_surfaces(self, is_broken: bool = False) -> None:
        """Writes the meshes, without the keyframes that still wait where a step is broken."""
        if self.reconstruction is None:
            return
        if is_broken:
            self.reconstruction.forget_waiting()
        if self.reconstruction.median_depths:
            dense = self.reconstruction
            self.empty_meshes = self.output.write_surfaces(*dense.surfaces(), self.scale, dense.voxel_lengths(), dense.filter_remark)

    def voxels(self) -> dict[str, float] | None:
        """Sides of the voxels in the unit of the output."""
        if self.reconstruction is None or not self.reconstruction.median_depths:
            return None
        low, high = self.reconstruction.voxel_lengths()
        return {"low": low * self.scale.metres_per_unit, "high": high * self.scale.metres_per_unit}


def _megabytes(size: dict[str, int] | None) -> dict[str, float] | None:
    return None if size is None else {"blocks": size["blocks"], "megabytes": round(size["bytes"] / 1e6, 1)}


def with_voxels(config: Config, scale: Scale) -> Config:
    """The settings with voxel sizes in map units: the paper's metres where the scale is known."""
    if not scale.is_known:
        return config
    low, high = config.fusion.voxel_low or VOXEL_LOW_M, config.fusion.voxel_high or VOXEL_HIGH_M
    fusion = dataclasses.replace(config.fusion, voxel_low=scale.units(low), voxel_high=scale.units(high))
    return dataclasses.replace(config, fusion=fusion)
