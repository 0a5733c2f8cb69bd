# SPDX-License-Identifier: Apache-2.0
"""Runs a sequence through the steps; the only place that knows about threads.

`run_sequential` does one thing after the other. `run_threaded` reads and computes curvature and flow ahead of the map
and reconstructs behind it, joined by bounded queues of immutable messages. Both give the same result.
"""

import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np

from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Array, FrontEndFrame, MapSnapshot, SlamState

READ_AHEAD = 4
SNAPSHOTS_AHEAD = 8

SnapshotSink = Callable[[MapSnapshot], None]


class Observer(Protocol):
    """Who is told how a run goes; called on the thread that maps."""

    def frame_done(self, done: int, total: int, slam: Slam) -> None: ...

    def frame_skipped(self, reason: Unreadable) -> None: ...

    def keyframe_done(self, done: int, total: int) -> None: ...

    def should_stop(self) -> bool: ...


class SilentObserver:
    """Hears nothing and never stops a run."""

    def frame_done(self, done: int, total: int, slam: Slam) -> None:
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
    interrupted: bool = False
    tracks: list[tuple[int, Array, Array]] | None = None
    """Frame index, ids (N,) and distorted pixels (N, 2) per frame, where they are kept."""


class _Run:
    """The steps of a run on the mapping thread, shared by both ways of running."""

    def __init__(self, slam: Slam, record: RunRecord, observer: Observer, sink: SnapshotSink | None) -> None:
        self.slam, self.record, self.observer, self.sink = slam, record, observer, sink

    def all_frames(self, fronts: Iterable[FrontEndFrame | Unreadable]) -> RunRecord:
        """Frame by frame until the end, or until the observer stops it; then the last keyframes are handed over."""
        for front in fronts:
            if self.observer.should_stop():
                self.record.interrupted = True
                break
            self.frame(front)
        self.hand_over(everything=True)
        return self.record

    def frame(self, front: FrontEndFrame | Unreadable) -> None:
        if isinstance(front, Unreadable):
            self.record.skipped.append(front)
            self.observer.frame_skipped(front)
        else:
            self.record.states.append(self.slam.process_frame(front))
            self._record_tracks(front.frame.index)
            self.hand_over()
        done = len(self.record.skipped) + len(self.record.states)
        self.observer.frame_done(done, self.record.num_frames, self.slam)

    def hand_over(self, everything: bool = False) -> None:
        """Keyframes that nothing will move any more go to the dense half."""
        for keyframe, frame in self.slam.take_settled_keyframes(everything):
            if self.sink is not None:
                self.sink(self.slam.snapshot(keyframe, frame))

    def _record_tracks(self, frame_index: int) -> None:
        seen = self.slam.tracks.select(self.slam.tracks.missed == 0)
        self.record.live_tracks.append(len(seen))
        if self.record.tracks is not None:
            self.record.tracks.append((frame_index, seen.ids, seen.pixels))


def run_sequential(
    dataset: Dataset,
    indices: range,
    front_end: FrontEnd,
    slam: Slam,
    sink: SnapshotSink | None = None,
    observer: Observer | None = None,
    keep_tracks: bool = False,
) -> RunRecord:
    """Runs the frames `indices` of a dataset, one step after the other.

    Args:
        sink: gets each keyframe once the window has left it, in order; None: the caller asks `slam` afterwards.
        observer: hears of each frame and may stop the run.
        keep_tracks: the record keeps the tracks of each frame.
    """
    run = _start(indices, slam, sink, observer, keep_tracks)
    return run.all_frames(_front_frames(dataset, indices, front_end))


def run_threaded(
    dataset: Dataset,
    indices: range,
    front_end: FrontEnd,
    slam: Slam,
    sink: SnapshotSink | None = None,
    observer: Observer | None = None,
    keep_tracks: bool = False,
) -> RunRecord:
    """As `run_sequential`, with a thread that reads ahead and one that calls `sink`; the result is the same.

    Raises:
        Whatever a worker raised, after the others have stopped.
    """
    with _Worker(SNAPSHOTS_AHEAD, sink) as dense, _ReadAhead(_front_frames(dataset, indices, front_end)) as fronts:
        run = _start(indices, slam, dense.put if sink else None, observer, keep_tracks)
        return run.all_frames(fronts)


def run_ahead(source: Iterator[Any]) -> Iterator[Any]:
    """The items of a generator, computed on a thread of its own a few items ahead; what it raises comes out here."""
    with _ReadAhead(source) as items:
        yield from items


def _start(indices: range, slam: Slam, sink: SnapshotSink | None, observer: Observer | None, keep_tracks: bool) -> _Run:
    cv2.setNumThreads(1)
    record = RunRecord(num_frames=len(indices), tracks=[] if keep_tracks else None)
    return _Run(slam, record, observer or SilentObserver(), sink)


def _front_frames(dataset: Dataset, indices: range, front_end: FrontEnd) -> Iterator[FrontEndFrame | Unreadable]:
    for index in indices:
        frame = dataset.read(index)
        yield frame if isinstance(frame, Unreadable) else front_end.process(frame)


class _Stopped(Exception):
    """The other end of a queue is gone."""


class _Channel:
    """A bounded queue that either end can close; then the other end's next call raises `_Stopped`."""

    def __init__(self, size: int) -> None:
        self._queue: queue.Queue[Any] = queue.Queue(maxsize=size)
        self.closed = threading.Event()

    def put(self, item: Any) -> None:
        while not self.closed.is_set():
            try:
                return self._queue.put(item, timeout=0.1)
            except queue.Full:
                continue
        raise _Stopped

    def get(self) -> Any:
        while True:
            try:
                return self._queue.get(timeout=0.1)
            except queue.Empty:
                if self.closed.is_set():
                    raise _Stopped from None


_END = object()


class _ReadAhead:
    """Iterates a generator on a thread of its own, at most READ_AHEAD items ahead; its exception comes out here."""

    def __init__(self, source: Iterator[Any]) -> None:
        self._source, self._channel = source, _Channel(READ_AHEAD)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="vitamin3d-front-end", daemon=True)

    def __enter__(self) -> "_ReadAhead":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._channel.closed.set()
        self._thread.join()

    def __iter__(self) -> Iterator[Any]:
        while (item := self._channel.get()) is not _END:
            yield item
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            for item in self._source:
                self._channel.put(item)
        except _Stopped:
            return
        except BaseException as error:
            self._error = error
        try:
            self._channel.put(_END)
        except _Stopped:
            return


class _Worker:
    """Calls a function on a thread of its own, item by item; its exception comes out of `put` or at the end."""

    def __init__(self, size: int, function: Callable[[Any], None] | None) -> None:
        self._function, self._channel = function, _Channel(size)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="vitamin3d-dense", daemon=True)

    def __enter__(self) -> "_Worker":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with contextlib.suppress(_Stopped):
            self._channel.put(_END)
        self._thread.join()
        if self._error is not None and (kind is None or kind is _Stopped):
            raise self._error

    def put(self, item: Any) -> None:
        self._channel.put(item)

    def _work(self) -> None:
        try:
            while (item := self._channel.get()) is not _END:
                if self._function is not None:
                    self._function(item)
        except BaseException as error:
            self._error = error
        finally:
            self._channel.closed.set()


def median_of(values: list[int]) -> float:
    """Median of a list, 0 for none."""
    return float(np.median(values)) if values else 0.0
