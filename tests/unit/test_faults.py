# SPDX-License-Identifier: Apache-2.0
"""A fault put into each step of each way of running: it stops, names the cause, saves what there is, and nothing hangs."""

import contextlib
import json
import os
import signal
import sys
import threading

import pytest
from scenes import DEMO

from vitamin3d.cli import main
from vitamin3d.commands.process import ONE_THREAD_EACH
from vitamin3d.datasets.base import PictureSequence
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import WorkerError
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.workers import Clock, Consumer, Errand, ReadAhead, step

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
LIMIT_SECONDS = 90
FRAME, KEYFRAME = 100, 1
WAYS = {"live": ["--live"], "live sequential": ["--live", "--sequential"], "threads": [], "sequential": ["--sequential"]}
FAULTS = {
    "reading": (PictureSequence, "read", FRAME, "reading picture 100"),
    "front end": (FrontEnd, "process", FRAME, "curvature and flow of frame 100"),
    "tracking": (Slam, "_localize", FRAME - 30, "tracking and mapping frame"),
    "adjusting": (Slam, "_solved", KEYFRAME, "mapping"),
    "meshing": (Reconstruction, "depth_view", KEYFRAME, "meshing"),
    "fusing": (Reconstruction, "fuse", KEYFRAME, "fusing"),
    "writing": (OutputFolder, "write_view", KEYFRAME, ""),
}
"""What breaks: class, method, at which call, and what the message names."""


@pytest.fixture(autouse=True)
def time_limit():
    """Whatever waits for ever is woken up, and fails."""

    def too_late(*_):
        raise TimeoutError(f"not done within {LIMIT_SECONDS} s")

    handler = signal.signal(signal.SIGALRM, too_late)
    signal.alarm(LIMIT_SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    assert [thread for thread in threading.enumerate() if thread.name.startswith("vitamin3d")] == []


@pytest.fixture
def broken(monkeypatch):
    """Makes a method raise at its n-th call and ever after."""

    def break_it(owner, name, at):
        whole, calls = getattr(owner, name), []

        def breaks(*arguments, **options):
            calls.append(name)
            if len(calls) > at:
                raise RuntimeError("a fault was put in")
            return whole(*arguments, **options)

        monkeypatch.setattr(owner, name, breaks)
        return calls

    return break_it


@pytest.fixture
def reconstruct(monkeypatch, capsys, tmp_path):
    """Runs the console script; exit code, what it said, and its folder."""
    for name in (*ONE_THREAD_EACH, "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, os.environ.get(name, "1" if name != "OMP_WAIT_POLICY" else "passive"))

    # However busy the machine, no keyframe is dropped before the one that breaks.
    monkeypatch.setattr("vitamin3d.runtime.LIVE_SNAPSHOTS_AHEAD", 1000)

    def run(*options):
        monkeypatch.setattr(sys, "argv", ["vitamin3d", "reconstruct", str(DEMO), "-q", "-o", str(tmp_path / "out"), *options])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capsys.readouterr()
        return caught.value.code or 0, out + err, tmp_path / "out"

    return run


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("fault", list(FAULTS))
def test_a_fault_stops_the_run_and_what_there_is_is_saved(reconstruct, broken, fault, way):
    owner, name, at, named = FAULTS[fault]
    broken(owner, name, at)
    code, said, out = reconstruct(*WAYS[way])
    assert code == 1 and "Traceback" not in said
    assert named in said and "RuntimeError: a fault was put in" in said
    stats = json.loads((out / "stats.json").read_text())
    assert "a fault was put in" in stats["failure"] and (out / "cloud.ply").exists()
    assert (out / "report.html").exists() or fault == "reading"  # which shows pictures
    is_early = "live" in way and fault in ("meshing", "fusing", "writing")  # whose first keyframes come early
    frames = {"adjusting": 20, "tracking": 60}.get(fault, 40 if is_early else 95)
    assert len(read_tum(out / "trajectory.tum")) >= frames
    assert not list(out.rglob("*.tmp"))
    if fault in ("reading", "front end", "tracking") and "live" in way:
        assert len(read_ply(out / "mesh_high.ply").triangles) > 1000


def test_a_fault_in_real_time(reconstruct, broken):
    broken(OutputFolder, "write_view", 1)
    code, said, out = reconstruct("--realtime", "--max-frames", "120")
    assert code == 1 and "a fault was put in" in said and (out / "stats.json").exists()


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
    with Errand("test") as errand:
        errand.begin(lambda: go.wait(10) and 42)
        assert errand.is_busy and errand.take() is None
        go.set()
        assert errand.take(wait=True) == 42 and not errand.is_busy and errand.take(wait=True) is None
        errand.begin(lambda: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            errand.take(wait=True)
    with Errand("test") as errand, contextlib.suppress(ZeroDivisionError):
        errand.begin(lambda: 1 // 0)
        while errand.take() is None:
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
