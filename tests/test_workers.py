# SPDX-License-Identifier: Apache-2.0
import contextlib
import threading

import pytest

from vitamin3d.errors import WorkerError
from vitamin3d.workers import BackgroundTask, Clock, Consumer, ReadAhead, step

pytestmark = pytest.mark.usefixtures("time_limit")


def test_a_fault_names_its_step_once():
    with pytest.raises(WorkerError, match=r"^inner: ValueError: cause$"), step("outer"), step("inner"):
        raise ValueError("cause")


def test_a_worker_that_fails_does_not_hold_those_that_feed_it():
    def consume(items):
        for item in items:
            if item == 3:
                raise ValueError("full")

    with pytest.raises(ValueError, match="full"), Consumer(consume, "test", 1) as consumer:
        for item in range(1000):
            consumer.put(item)


def test_what_was_put_before_the_end_is_consumed():
    seen = []
    with Consumer(seen.extend, "test", 2) as consumer:
        for item in range(50):
            consumer.put(item)
    assert seen == list(range(50))


def test_a_reader_is_stopped_while_it_waits_for_room():
    taken = []

    def source():
        for item in range(1000):
            taken.append(item)
            yield item

    with ReadAhead(source(), "test", 3) as items:
        assert next(iter(items)) == 0
    assert len(taken) < 10


def test_an_errand_is_run_beside_and_its_fault_comes_out():
    go = threading.Event()
    with BackgroundTask("test") as task:
        task.begin(lambda: go.wait(10) and 42)
        assert task.is_busy and task.take() is None
        go.set()
        assert task.take(wait=True) == 42 and not task.is_busy and task.take(wait=True) is None
        task.begin(lambda: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            task.take(wait=True)
    with BackgroundTask("test") as task, contextlib.suppress(ZeroDivisionError):
        task.begin(lambda: 1 // 0)
        while task.take() is None:
            pass


def test_the_clock_waits_until_a_picture_is_due_or_is_cancelled():
    clock = Clock()
    clock.wait_for(5_000_000_000)
    assert 0.0 <= clock.seconds_since(5_000_000_000) < 1.0
    clock.wait_for(5_050_000_000)
    assert clock.seconds_since(5_050_000_000) >= 0.0
    threading.Timer(0.05, clock.cancel).start()
    clock.wait_for(10**15)
    assert clock.seconds_since(10**15) < 0.0
