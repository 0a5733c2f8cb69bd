# SPDX-License-Identifier: Apache-2.0
"""Runs a sequence through the steps.

`run_sequential` does one thing after the other. `run_threaded` decodes pictures and computes curvature and flow ahead of
the map and reconstructs behind it, joined by bounded queues of immutable messages; both give the same result. `run_live`
never lets a frame wait for the back end: windows are adjusted on a thread of their own while the camera is tracked on, and
keyframes for which the dense half has no time are not meshed.
"""

import gc
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np

from vitamin3d.atlas import Atlas
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.mapping.window_adjustment import AdjustAtOnce, WindowAdjustment
from vitamin3d.slam import Slam
from vitamin3d.steps import PixelFrontEnd
from vitamin3d.types import Array, Frame, FrontEndFrame, MapSnapshot, NewestFrame, SlamState
from vitamin3d.workers import BackgroundTask, Clock, Consumer, ReadAhead, step

READ_AHEAD = 4
SNAPSHOTS_AHEAD, LIVE_SNAPSHOTS_AHEAD = 8, 3
ADJUSTMENT_NICENESS, DENSE_NICENESS = 3, 10
"""In live runs the front end comes first, then the map, then the mesh."""

KeyframeHandler = Callable[[Slam, int, Frame, bool], None]
"""Takes a settled keyframe of a map and its picture; True: the recording is over."""
SnapshotConsumer = Callable[[Iterator[MapSnapshot | NewestFrame]], None]
"""Consumes keyframes as they come, on a thread of its own; in live runs, while none comes, it hears how late it is."""
TimeHandler = Callable[[int], None]
"""Hears of each frame's time (ns) when the frame is done."""
SnapshotSink = Callable[[MapSnapshot], None]


class Observer(Protocol):
    """Who is told how a run goes; called on the thread that maps."""

    def frame_done(self, done: int, total: int, atlas: Atlas) -> None: ...

    def frame_skipped(self, reason: Unreadable) -> None: ...

    def keyframe_done(self, done: int, total: int) -> None: ...

    def should_stop(self) -> bool: ...


class SilentObserver:
    """Hears nothing and never stops a run."""

    def frame_done(self, done: int, total: int, atlas: Atlas) -> None:
        pass

    def frame_skipped(self, reason: Unreadable) -> None:
        pass

    def keyframe_done(self, done: int, total: int) -> None:
        pass

    def should_stop(self) -> bool:
        return False


@dataclass
class RunRecord:
    """What happened frame by frame."""

    num_frames: int = 0
    """Asked for, the unreadable ones included."""
    skipped: list[Unreadable] = field(default_factory=list)
    live_tracks: list[int] = field(default_factory=list)
    states: list[SlamState] = field(default_factory=list)
    frame_seconds: list[tuple[SlamState, float]] = field(default_factory=list)
    """State after a frame, and how long tracking and mapping it took, the front end not counted."""
    front_end_seconds: list[float] = field(default_factory=list)
    """Of each frame; on a thread of its own where there are threads."""
    interrupted: bool = False
    tracks: list[tuple[int, Array, Array]] | None = None
    """Frame index, ids (N,) and distorted pixels (N, 2) per frame, where they are kept."""
    keyframes_offered: int = 0
    """To the dense half."""
    keyframes_dropped: int = 0
    """Which the dense half had no time for (live runs)."""
    adjustments_awaited: int = 0
    """Keyframes that waited for the adjustment of the window before (runs with a clock)."""
    latencies: list[tuple[int, float]] | None = None
    """Frame index, and seconds from when its picture was due until it was done; where there is a clock."""


class _Run:
    """The steps of a run on the mapping thread, shared by all ways of running."""

    def __init__(self, atlas: Atlas, record: RunRecord, observer: Observer, handle: KeyframeHandler, clock: Clock | None = None) -> None:
        self.atlas, self.record, self.observer, self.handle, self.clock = atlas, record, observer, handle, clock
        self.tell_time: TimeHandler = lambda timestamp_ns: None

    def all_frames(self, fronts: Iterable[FrontEndFrame | Unreadable]) -> RunRecord:
        """Frame by frame until the end, or until the observer stops it; then the last keyframes are handed over."""
        for front in fronts:
            if self.observer.should_stop():
                self.record.interrupted = True
                break
            self.frame(front)
        with step("mapping"):
            self.atlas.take_adjustment(wait=True)
        self.deliver_keyframes(everything=True)
        return self.record

    def frame(self, front: FrontEndFrame | Unreadable) -> None:
        if isinstance(front, Unreadable):
            self.record.skipped.append(front)
            self.observer.frame_skipped(front)
        else:
            begun = time.perf_counter()
            with step(f"tracking and mapping frame {front.frame.index}"):
                state = self.atlas.process_frame(front)
            self.record.states.append(state)
            self.record.frame_seconds.append((state, time.perf_counter() - begun))
            if self.clock is not None and self.record.latencies is not None:
                self.record.latencies.append((front.frame.index, self.clock.seconds_since(front.frame.timestamp_ns)))
            self._record_tracks(front.frame.index)
            self.deliver_keyframes()
            self.tell_time(front.frame.timestamp_ns)
        done = len(self.record.skipped) + len(self.record.states)
        self.observer.frame_done(done, self.record.num_frames, self.atlas)

    def deliver_keyframes(self, everything: bool = False) -> None:
        """Keyframes that nothing will move any more go to the dense half."""
        for slam, keyframe, frame in self.atlas.take_settled_keyframes(everything):
            self.handle(slam, keyframe, frame, everything)

    def _record_tracks(self, frame_index: int) -> None:
        slam = self.atlas.current
        seen = slam.tracks.select(slam.tracks.missed == 0)
        self.record.live_tracks.append(len(seen))
        if self.record.tracks is not None:
            self.record.tracks.append((frame_index, seen.ids, seen.pixels))


def run_sequential(
    dataset: Dataset,
    indices: range,
    front_end: PixelFrontEnd,
    atlas: Atlas,
    sink: SnapshotSink | None = None,
    observer: Observer | None = None,
    record: RunRecord | None = None,
) -> RunRecord:
    """Runs the frames `indices` of a dataset, one step after the other.

    Args:
        sink: gets each keyframe once the window has left it, in order; None: the caller asks `atlas` afterwards.
        observer: hears of each frame and may stop the run.
        record: is filled while the run lasts, so that it is there when a step fails; it keeps tracks where it has a list for them.

    Raises:
        WorkerError: a step failed; it names the step.
    """
    record = _begin(indices, record)
    run = _Run(atlas, record, observer or SilentObserver(), _deliver_to(record, sink))
    return run.all_frames(_front_frames(_pictures(dataset, indices), front_end, record))


def run_threaded(
    dataset: Dataset,
    indices: range,
    front_end: PixelFrontEnd,
    atlas: Atlas,
    sink: SnapshotSink | None = None,
    observer: Observer | None = None,
    record: RunRecord | None = None,
) -> RunRecord:
    """As `run_sequential`, with threads that decode and compute the front end ahead and one that calls `sink`; the result is the same."""
    record = _begin(indices, record)
    with ExitStack() as threads:
        put = threads.enter_context(Consumer(_each_to(sink), "dense", SNAPSHOTS_AHEAD)).put if sink else None
        fronts = threads.enter_context(_fronts_ahead(threads, _pictures(dataset, indices), front_end, record))
        return _Run(atlas, record, observer or SilentObserver(), _deliver_to(record, put)).all_frames(fronts)


def run_live(
    dataset: Dataset,
    indices: range,
    front_end: PixelFrontEnd,
    atlas: Atlas,
    consume: SnapshotConsumer | None = None,
    observer: Observer | None = None,
    record: RunRecord | None = None,
    clock: Clock | None = None,
) -> RunRecord:
    """As `run_threaded`, but the camera does not wait for meshes: what there is no time for is dropped.

    Args:
        consume: iterates over the keyframes that are to be meshed, on a thread of its own.
        clock: pictures come when their time stamps say, and windows are adjusted beside the tracking; None: pictures come as fast as
            they are tracked.

    Which keyframes are meshed, and with a clock when a window's adjustment reaches the map, depends on how busy the machine is.
    """
    record = _begin(indices, record)
    record.latencies = [] if clock is not None else None
    with ExitStack() as threads:
        gc.collect()
        gc.freeze()  # what is there now is not looked through again while pictures come
        threads.callback(gc.unfreeze)
        dense = threads.enter_context(Consumer(consume, "dense", LIVE_SNAPSHOTS_AHEAD, DENSE_NICENESS)) if consume else None
        if clock is not None:
            adjuster: BackgroundTask[WindowAdjustment] = BackgroundTask("adjustment", ADJUSTMENT_NICENESS)
            atlas.adjuster.work_with(threads.enter_context(adjuster))
            threads.callback(lambda: atlas.adjuster.work_with(AdjustAtOnce()))
        fronts = threads.enter_context(_fronts_ahead(threads, _pictures(dataset, indices), front_end, record, clock))
        if clock is not None:
            threads.callback(clock.cancel)
        run = _Run(atlas, record, observer or SilentObserver(), _deliver_or_drop(record, dense), clock)
        if dense is not None:
            run.tell_time = _tell_while_waiting(dense)
        run.all_frames(fronts)
        record.adjustments_awaited = atlas.adjustments_awaited
        return record


def _begin(indices: range, record: RunRecord | None) -> RunRecord:
    cv2.setNumThreads(1)
    record = record if record is not None else RunRecord()
    record.num_frames = len(indices)
    return record


def _pictures(dataset: Dataset, indices: range) -> Iterator[Frame | Unreadable]:
    for index in indices:
        with step(f"reading picture {index}"):
            frame = dataset.read(index)
        yield frame


def _front_frames(
    pictures: Iterable[Frame | Unreadable], front_end: PixelFrontEnd, record: RunRecord, clock: Clock | None = None
) -> Iterator[FrontEndFrame | Unreadable]:
    for picture in pictures:
        if isinstance(picture, Unreadable):
            yield picture
            continue
        if clock is not None:
            clock.wait_for(picture.timestamp_ns)
        with step(f"curvature and flow of frame {picture.index}"):
            begun = time.perf_counter()
            front = front_end.process(picture)
        record.front_end_seconds.append(time.perf_counter() - begun)
        yield front


def _fronts_ahead(
    threads: ExitStack, pictures: Iterator[Frame | Unreadable], front_end: PixelFrontEnd, record: RunRecord, clock: Clock | None = None
) -> ReadAhead:
    decoded = threads.enter_context(ReadAhead(pictures, "decoding", READ_AHEAD))
    return ReadAhead(_front_frames(decoded, front_end, record, clock), "front-end", READ_AHEAD, upstream=decoded)


def _each_to(sink: SnapshotSink) -> SnapshotConsumer:
    def consume(snapshots: Iterator[MapSnapshot | NewestFrame]) -> None:
        for snapshot in snapshots:
            if isinstance(snapshot, MapSnapshot):
                with step(f"meshing and fusing frame {snapshot.frame.index}"):
                    sink(snapshot)

    return consume


def _tell_while_waiting(dense: Consumer) -> TimeHandler:
    def tell(timestamp_ns: int) -> None:
        if dense.is_waiting:
            dense.put(NewestFrame(timestamp_ns))

    return tell


def _deliver_to(record: RunRecord, sink: SnapshotSink | None) -> KeyframeHandler:
    """Every keyframe goes to `sink`, which may take its time."""

    def handle(slam: Slam, keyframe: int, frame: Frame, _: bool) -> None:
        if sink is not None:
            record.keyframes_offered += 1
            with step(f"meshing and fusing frame {frame.index}"):
                sink(slam.snapshot(keyframe, frame))

    return handle


def _deliver_or_drop(record: RunRecord, dense: Consumer | None) -> KeyframeHandler:
    """A keyframe for which the dense half has no room is dropped, unless the recording is over."""

    def handle(slam: Slam, keyframe: int, frame: Frame, is_over: bool) -> None:
        if dense is None:
            return
        record.keyframes_offered += 1
        if is_over or dense.has_room:
            dense.put(slam.snapshot(keyframe, frame))
        else:
            record.keyframes_dropped += 1

    return handle


def median_of(values: list[int]) -> float:
    """Median of a list, 0 for none."""
    return float(np.median(values)) if values else 0.0
