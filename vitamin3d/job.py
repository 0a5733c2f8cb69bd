# SPDX-License-Identifier: Apache-2.0
"""The whole job: a sequence in, an output folder with trajectory, cloud, meshes and maps out."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from vitamin3d.config import Config
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.errors import InputError
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.mapping.landmark_statistics import point_cloud
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.run_report import write_report
from vitamin3d.run_statistics import Stopwatch, run_statistics
from vitamin3d.runtime import Observer, RunRecord, run_ahead, run_sequential, run_threaded
from vitamin3d.scale import Scale, scale_from_ground_truth
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import MapSnapshot

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
    """Keyframes are fused while the camera is tracked; else after the final adjustment of the map."""


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
    """
    watch, indices = Stopwatch(), job.selection.indices(len(dataset))
    _check_scale_source(dataset, job)
    job = _with_steady_camera(job)
    front_end, slam = FrontEnd(job.config), Slam(dataset.camera, job.config)
    scale = Scale(job.metric_scale, "given") if job.metric_scale else Scale()
    dense = _Dense(dataset, job, output, scale)
    run = run_threaded if job.threads else run_sequential
    try:
        record = run(dataset, indices, front_end, slam, dense.add if job.live else None, observer, job.save_tracks)
    except Exception:
        _write_sparse(slam, scale, output, job)
        dense.write_surfaces()
        raise
    slam.finish()
    if slam.map.num_keyframes and not job.live:
        dense.camera = slam.camera
        dense.scale = scale = scale_from_ground_truth(slam.trajectory(), dataset.ground_truth()) if job.scale_from_truth else scale
        dense.add_all(slam, observer)
    cloud_points = _write_sparse(slam, scale, output, job)
    dense.write_surfaces()
    if record.tracks is not None:
        output.write_tracks(record.tracks)
    times = [front_end.times, slam.times, *([dense.reconstruction.times] if dense.reconstruction else [])]
    stats = run_statistics(slam, record, scale, cloud_points, times, watch)
    stats |= {"source": dataset.name, "mode": job.config.mode, "voxels": dense.voxels(), "skipped": [_line(s) for s in record.skipped]}
    output.write_stats(stats)
    write_report(output.path, dataset, slam, record)
    return Outcome(slam, record, scale, stats)


def _check_scale_source(dataset: Dataset, job: Job) -> None:
    """InputError where the scale is to come from a ground truth that is not there, or not there in time."""
    if job.scale_from_truth and dataset.ground_truth() is None:
        raise InputError(f"{dataset.name}: --scale-from-ground-truth, but the source has no ground truth; use --metric-scale")
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

    def __init__(self, dataset: Dataset, job: Job, output: OutputFolder, scale: Scale) -> None:
        self.dataset, self.job, self.output, self.scale, self.camera = dataset, job, output, scale, dataset.camera
        self.reconstruction: Reconstruction | None = None

    def add(self, snapshot: MapSnapshot) -> None:
        """Takes a keyframe; fuses those that are ready and writes their maps."""
        for view in self._begun().add_keyframe(snapshot):
            self.output.write_view(view, self.scale)

    def add_all(self, slam: Slam, observer: Observer) -> None:
        """All keyframes of a finished map, their pictures read again; the views are computed ahead of the fusion."""
        order = {time: k for k, time in enumerate(slam.map.timestamps_ns, 1)}
        views = self._begun().depth_views(self._snapshots(slam))
        for view in run_ahead(views) if self.job.threads else views:
            self._begun().fuse(view)
            self.output.write_view(view, self.scale)
            observer.keyframe_done(order[view.timestamp_ns], slam.map.num_keyframes)

    def _snapshots(self, slam: Slam) -> Iterator[MapSnapshot]:
        for keyframe, frame_index in enumerate(slam.map.frame_indices):
            frame = self.dataset.read(frame_index)
            if not isinstance(frame, Unreadable):
                yield slam.snapshot(keyframe, frame)

    def _begun(self) -> Reconstruction:
        if self.reconstruction is None:
            self.reconstruction = Reconstruction(self.camera, with_voxels(self.job.config, self.scale))
            self.output.write_canvas(self.reconstruction.canvas, self.scale)
        return self.reconstruction

    def write_surfaces(self) -> None:
        """Fuses what still waits, and writes the meshes."""
        if self.reconstruction is None:
            return
        for view in self.reconstruction.finish():
            self.output.write_view(view, self.scale)
        if self.reconstruction.median_depths:
            self.output.write_surfaces(*self.reconstruction.surfaces(), self.scale, self.reconstruction.voxel_lengths())

    def voxels(self) -> dict[str, float] | None:
        """Sides of the voxels in the unit of the output."""
        if self.reconstruction is None or not self.reconstruction.median_depths:
            return None
        low, high = self.reconstruction.voxel_lengths()
        return {"low": low * self.scale.metres_per_unit, "high": high * self.scale.metres_per_unit}


def with_voxels(config: Config, scale: Scale) -> Config:
    """The settings with voxel sizes in map units: the paper's metres where the scale is known."""
    if not scale.is_known:
        return config
    low, high = config.fusion.voxel_low or VOXEL_LOW_M, config.fusion.voxel_high or VOXEL_HIGH_M
    fusion = dataclasses.replace(config.fusion, voxel_low=scale.units(low), voxel_high=scale.units(high))
    return dataclasses.replace(config, fusion=fusion)
