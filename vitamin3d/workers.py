# SPDX-License-Identifier: Apache-2.0
"""Threads and the bounded queues between them; the only file that knows about threads.

A step that fails on any thread comes out on the caller's as a `WorkerError` that names the step; our own errors
(bad input, a full disk) come out as they are. Nothing waits for a thread that is gone.
"""

import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar

from vitamin3d.errors import Vitamin3dError, WorkerError

Result = TypeVar("Result")
POLL_SECONDS = 0.1
"""Between two looks whether the other end of a queue is still there."""


class Stopped(Exception):
    """The other end of a queue is gone."""


@contextmanager
def step(name: str) -> Iterator[None]:
    """Turns what goes wrong inside into a `WorkerError` that names the step."""
    try:
        yield
    except (Vitamin3dError, Stopped):
        raise
    except Exception as error:
        raise WorkerError(f"{name}: {type(error).__name__}: {error}") from error


class Channel:
    """A bounded queue that either end can close; then the other end's next call raises `Stopped`."""

    def __init__(self, size: int) -> None:
        self._queue: queue.Queue[Any] = queue.Queue(maxsize=size)
        self._closed = threading.Event()

    def put(self, item: Any) -> None:
        """Waits for room."""
        while not self._closed.is_set():
            with contextlib.suppress(queue.Full):
                return self._queue.put(item, timeout=POLL_SECONDS)
        raise Stopped

    @property
    def has_room(self) -> bool:
        """Whether `put` would not wait; for the only thread that puts."""
        return not self._queue.full()

    @property
    def is_empty(self) -> bool:
        """Whether everything that was put was taken."""
        return self._queue.empty()

    def get(self) -> Any:
        """Waits for an item; what was put before the queue was closed still comes out."""
        while True:
            try:
                return self._queue.get(timeout=POLL_SECONDS)
            except queue.Empty:
                if self._closed.is_set():
                    raise Stopped from None

    def close(self) -> None:
        self._closed.set()

    @property
    def is_closed(self) -> bool:
        return self._closed.is_set()


_END = object()


class _Thread:
    """A named thread whose exception is kept; a higher `niceness` gives way to the others (Linux)."""

    def __init__(self, name: str, niceness: int) -> None:
        self._niceness = niceness
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"vitamin3d-{name}", daemon=True)

    def _run(self) -> None:
        with contextlib.suppress(AttributeError, OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + self._niceness)
        try:
            self._work()
        except Stopped:
            pass
        except BaseException as error:
            self._error = error
        finally:
            self._end()

    def _work(self) -> None:
        raise NotImplementedError

    def _end(self) -> None:
        """On the thread, when it has worked, whatever came of it."""

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error


class Closable(Protocol):
    """Something that another thread may wait for."""

    def close(self) -> None: ...


class Items(Iterator[Any]):
    """What comes through a channel until its end; `close` says that no more is wanted, to both ends."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    def __next__(self) -> Any:
        item = self._channel.get()
        if item is _END:
            raise StopIteration
        return item

    def close(self) -> None:
        self._channel.close()


class ReadAhead(_Thread):
    """Iterates a generator on a thread of its own, at most `size` items ahead; its exception comes out here.

    Args:
        upstream: what the generator may wait for, closed with this so that nobody waits for ever.
    """

    def __init__(self, source: Iterator[Any], name: str, size: int, niceness: int = 0, upstream: Closable | None = None) -> None:
        super().__init__(name, niceness)
        self._source, self._channel, self._upstream = source, Channel(size), upstream

    def __enter__(self) -> "ReadAhead":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        self._thread.join()

    def close(self) -> None:
        """No more is wanted."""
        self._channel.close()
        if self._upstream is not None:
            self._upstream.close()

    def __iter__(self) -> Iterator[Any]:
        yield from Items(self._channel)
        self._raise()

    def _work(self) -> None:
        for item in self._source:
            self._channel.put(item)

    def _end(self) -> None:
        with contextlib.suppress(Stopped):
            self._channel.put(_END)


class Consumer(_Thread):
    """Hands items to a function that iterates over them, on a thread of its own.

    Its exception comes out of the next `put` or at the end; what was put before the end is still consumed.
    """

    def __init__(self, consume: Callable[[Iterator[Any]], None], name: str, size: int, niceness: int = 0) -> None:
        super().__init__(name, niceness)
        self._consume, self._channel = consume, Channel(size)

    def __enter__(self) -> "Consumer":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with contextlib.suppress(Stopped):
            self._channel.put(_END)
        self._thread.join()
        if kind is None or kind is Stopped:
            self._raise()

    @property
    def has_room(self) -> bool:
        return self._channel.has_room

    @property
    def is_waiting(self) -> bool:
        """Whether all items were taken."""
        return self._channel.is_empty

    def put(self, item: Any) -> None:
        try:
            self._channel.put(item)
        except Stopped:
            self._raise()
            raise

    def _work(self) -> None:
        self._consume(Items(self._channel))

    def _end(self) -> None:
        self._channel.close()


class BackgroundTask(_Thread, Generic[Result]):
    """One task at a time on a thread of its own: `begin` one, go on, `take` what it came to."""

    def __init__(self, name: str, niceness: int = 0) -> None:
        super().__init__(name, niceness)
        self._tasks, self._results = Channel(1), Channel(1)
        self.is_busy = False
        """A task was begun and its result is not taken yet."""

    def __enter__(self) -> "BackgroundTask[Result]":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._tasks.close()
        self._thread.join()

    def begin(self, task: Callable[[], Result]) -> None:
        """Starts a task; not while busy."""
        self._tasks.put(task)
        self.is_busy = True

    def take(self, wait: bool = False) -> Result | None:
        """The result of the task, once; None where there is none (yet). Raises what the task raised."""
        if not self.is_busy or (not wait and self._results.has_room and not self._results.is_closed):
            return None
        try:
            result: Result = self._results.get()
        except Stopped:
            self._raise()
            raise
        self.is_busy = False
        return result

    def _work(self) -> None:
        while True:
            self._results.put(self._tasks.get()())

    def _end(self) -> None:
        self._tasks.close()
        self._results.close()


class Clock:
    """Real time for a recording: its time stamps are when its pictures are due. Stands still until `start`."""

    def __init__(self) -> None:
        self._cancelled = threading.Event()
        self._zero_ns: int | None = None

    def wait_for(self, timestamp_ns: int) -> None:
        """Until a picture is due; the first one starts the clock. Returns at once after `cancel`."""
        if self._zero_ns is None:
            self._zero_ns = time.monotonic_ns() - timestamp_ns
        self._cancelled.wait(max(0.0, -self.seconds_since(timestamp_ns)))

    def seconds_since(self, timestamp_ns: int) -> float:
        """How long ago a picture was due."""
        assert self._zero_ns is not None, "the clock was not started"
        return (time.monotonic_ns() - self._zero_ns - timestamp_ns) / 1e9

    def cancel(self) -> None:
        """Nobody waits any more."""
        self._cancelled.set()
