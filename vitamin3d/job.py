# SPDX-License-Identifier: Apache-2.0
"""The whole job: a sequence in, an output folder with trajectories, clouds, meshes and maps out."""

import dataclasses
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.errors import InputError
from vitamin3d.exporters.output_folder import MapFolder, OutputFolder
from vitamin3d.map_output import MapOutput, MapOutputs
from vitamin3d.mapping.landmark_statistics import information_by_row
from vitamin3d.run_gaps import Gap, find_gaps, gaps_table, no_map_sentence
from vitamin3d.run_report import write_report
from vitamin3d.run_statistics import Stopwatch, live_table, map_table, run_statistics
from vitamin3d.runtime import Observer, RunRecord, run_live, run_sequential, run_threaded
from vitamin3d.scale import Scale, scale_from_ground_truth
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import DepthView, MapSnapshot, StepTimes
from vitamin3d.warmup import warm_up
from vitamin3d.workers import Clock, step


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

    atlas: Atlas
    record: RunRecord
    scale: Scale
    """Of the largest map."""
    stats: dict[str, Any]
    gaps: list[Gap]
    """Stretches of frames that no map has."""

    @property
    def has_map(self) -> bool:
        return bool(self.atlas.ranked())


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
        self.front_end, self.atlas = FrontEnd(config), Atlas(dataset.camera, config)
        self.record = RunRecord(tracks=[] if job.save_tracks else None)
        self.clock = Clock() if job.realtime else None
        self.dense_times = StepTimes()
        self.outputs = MapOutputs(self._begin, job.threads, job.live)
        self.maps: list[Slam] = []
        """The largest first; none while frames come."""

    def _begin(self, number: int) -> MapOutput:
        """The output of a map; while frames come, maps are ranked by their births."""
        rank = next((r for r, slam in self._ranked() if slam.number == number), 1 + len(self.outputs.by_number))
        is_finished = bool(self.maps) and not self.job.live
        slam = self.maps[rank - 1] if is_finished else None
        camera, num_keyframes = (slam.camera, slam.map.num_keyframes) if slam else (self.dataset.camera, 0)
        scale = Scale(self.job.metric_scale, "given") if self.job.metric_scale and rank == 1 else Scale()
        made = MapOutput(camera, self.job.config, self._folder(rank), scale, self.dense_times, self.clock, num_keyframes)
        made.empty_meshes = made.empty_meshes if self.job.mesh else []
        return made

    def _folder(self, rank: int) -> MapFolder:
        about_scale = ", and its scale is unknown: --metric-scale is that of another one" if self.job.metric_scale else ""
        return self.output.map_folder(rank, f"map {rank} of the run: it has a world of its own{about_scale}")

    def _ranked(self) -> Iterator[tuple[int, Slam]]:
        return enumerate(self.maps, 1)

    def reconstruct(self) -> None:
        """Everything but the files that are written at the end."""
        if self.job.realtime:
            warm_up([self.job.config])
        source = (self.dataset, self.indices, self.front_end, self.atlas)
        if self.job.live and self.job.threads:
            run_live(*source, self.outputs.add_all if self.job.mesh else None, self.observer, self.record, self.clock)
        else:
            run = run_threaded if self.job.threads else run_sequential
            run(*source, self.outputs.add if self.job.live and self.job.mesh else None, self.observer, self.record)
        self.outputs.finish()
        with step("final adjustment"):
            self.atlas.finish()
        self._rank()
        if self.job.live:
            for _, slam in self._ranked():
                self.outputs.of(slam.number).fuse_again(slam.trajectory())
        else:
            self._take_scales()
            if self.job.mesh:
                self.outputs.add_all(self._snapshots(), self._keyframe_done)

    def _rank(self) -> None:
        """The maps that there are, the largest in OUT; what was written of others is moved, and of dropped ones removed."""
        self.maps = self.atlas.ranked()
        rank_of = {slam.number: rank for rank, slam in self._ranked()}
        begun = dict(self.outputs.by_number)
        ranks = [rank_of.get(number) for number in begun]
        if ranks != list(range(1, len(begun) + 1)):
            self.output.arrange([output.folder for output in begun.values()], ranks)
        for output, rank in zip(begun.values(), ranks, strict=True):
            output.folder = output.folder if rank is None else self._folder(rank)
        self.outputs.by_number = {number: self.outputs.of(number) for number in rank_of}

    def _take_scales(self) -> None:
        """Each map's own, where the ground truth has it; a lesser map that is too short for that has none."""
        for rank, slam in self._ranked() if self.job.scale_from_truth else ():
            try:
                self.outputs.of(slam.number).scale = scale_from_ground_truth(slam.trajectory(), self.dataset.ground_truth())
            except InputError:
                if rank == 1:
                    raise

    def _snapshots(self) -> Iterator[MapSnapshot]:
        """The keyframes of the finished maps, their pictures read again."""
        for _, slam in self._ranked():
            by_row = information_by_row(slam.map, slam.camera)
            for keyframe, frame_index in enumerate(slam.map.frame_indices):
                frame = self.dataset.read(frame_index)
                if not isinstance(frame, Unreadable):
                    yield slam.snapshot(keyframe, frame, by_row)

    def _keyframe_done(self, output: MapOutput, view: DepthView) -> None:
        done = 0
        for _, slam in self._ranked():
            is_here = self.outputs.of(slam.number) is output
            done += bisect_right(slam.map.timestamps_ns, view.timestamp_ns) if is_here else slam.map.num_keyframes
            if is_here:
                break
        self.observer.keyframe_done(done, sum(slam.map.num_keyframes for slam in self.maps))

    def save(self) -> Outcome:
        """Writes what is there."""
        self.output.write_config(self.job.config)
        for _, slam in self._ranked():
            output = self.outputs.of(slam.number)
            output.write_sparse(slam)
            output.write_surfaces()
        return self._conclude()

    def save_after(self, failure: Exception) -> None:
        """Writes what can still be written; whatever fails now has the same cause, or a later one that matters less."""
        with suppress(Exception):
            self.output.write_config(self.job.config)
        with suppress(Exception):
            self._rank()
        for _, slam in self._ranked():
            with suppress(Exception):
                self.outputs.of(slam.number).write_sparse(slam)
        for output in self.outputs.by_number.values():
            with suppress(Exception):
                output.finish()
            with suppress(Exception):
                output.write_surfaces(is_broken=True)
        with suppress(Exception):
            self._conclude(failure)

    def _conclude(self, failure: Exception | None = None) -> Outcome:
        if self.record.tracks is not None:
            self.output.write_tracks(self.record.tracks)
        outputs = [self.outputs.of(slam.number) for slam in self.maps]
        largest = outputs[0] if outputs else self.outputs.of(self.atlas.current.number)
        times = [self.front_end.times, self.atlas.times, self.dense_times]
        stats = run_statistics(self.atlas, self.record, largest, times, self.watch)
        stats |= {"source": self.dataset.name, "mode": self.job.config.mode, "voxels": largest.voxels(), "volumes": largest.volumes()}
        stats |= {"empty_meshes": largest.empty_meshes}
        stats |= {"maps": [map_table(slam, rank, self.outputs.of(slam.number)) for rank, slam in self._ranked()]}
        gaps = self._note_gaps(stats)
        stats |= {"remarks": self.dataset.remarks}
        stats |= {"skipped": [_line(s) for s in self.record.skipped], "failure": str(failure) if failure else None}
        stats |= {"live": live_table(self.record, *_lags(self.outputs)) if self.job.live else None}
        self.output.write_stats(stats)
        write_report(self.output.path, self.dataset, self.atlas, self.record)
        return Outcome(self.atlas, self.record, largest.scale, stats, gaps)

    def _note_gaps(self, stats: dict[str, Any]) -> list[Gap]:
        """Which frames no map has, into the statistics; and why there is no map, from all frames instead of the last."""
        notes, width_px = self.atlas.notes, self.dataset.camera.width
        gaps = find_gaps(notes, [slam.trajectory().timestamps_ns for slam in self.maps], width_px)
        stats |= {"first_frame_s": notes[0].timestamp_ns / 1e9 if notes else None, "not_localised": gaps_table(gaps)}
        if not self.maps:
            stats["initialization_failure"] = no_map_sentence(notes, stats["initialization_failure"], width_px)
        return gaps


def _lags(outputs: MapOutputs) -> tuple[list[float], float | None]:
    """How late the views of all maps came, and the very first of the map that came first."""
    begins = [output.mesh_begins for _, output in sorted(outputs.by_number.items()) if output.mesh_begins is not None]
    return [lag for output in outputs.by_number.values() for lag in output.mesh_lags], begins[0] if begins else None


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


def _line(skipped: Unreadable) -> str:
    return f"{skipped.path.name}: {skipped.reason}"
