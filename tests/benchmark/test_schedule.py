# SPDX-License-Identifier: Apache-2.0
"""Lost processes are replaced."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scenes import DEMO, SHORT_RUN, demo_copy

from vitamin3d.benchmark import schedule
from vitamin3d.benchmark.schedule import run_local
from vitamin3d.benchmark.trial import SequenceJob, result_file, run_sequence
from vitamin3d.errors import InputError, Vitamin3dError

ROOT = Path(__file__).parents[2]


def children_of(pid):
    """Process ids below one, at any depth."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except OSError:
                continue
    found, todo = [], [pid]
    while todo:
        todo = [child for child, parent in parents.items() if parent in todo]
        found += todo
    return found


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_kernels")
@pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc")
def test_killed_in_the_middle_and_started_again(tmp_path):
    """The children die with it, and the second start runs only what is missing."""
    for name in ("a", "b"):
        demo_copy(tmp_path / "root" / name)
    arguments = [sys.executable, "-m", "vitamin3d.cli", "benchmark", "euroc", str(tmp_path / "root"), "-o", str(tmp_path / "out")]
    arguments += ["--trials", "1", *SHORT_RUN]
    first = subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    done, later = tmp_path / "out" / "a" / "trial_0.json", tmp_path / "out" / "b" / "trial_0.json"
    wait_for(lambda: done.is_file() and len(children_of(first.pid)) >= 2)
    children = children_of(first.pid)
    first.kill()
    first.wait()
    wait_for(lambda: not any(Path(f"/proc/{child}/exe").exists() for child in children), 60)
    assert not later.is_file()
    stamp = done.stat().st_mtime_ns
    second = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
    assert second.returncode == 0, second.stderr
    assert done.stat().st_mtime_ns == stamp and later.is_file()
    a, b = (json.loads(path.read_text()) for path in (done, later))
    assert a["ate"] == b["ate"], "the same pictures and seed"
    assert "| a (45) |" in second.stdout and "| b (45) |" in second.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc")
def test_a_lost_process_is_replaced(tmp_path, monkeypatch):
    job = SequenceJob("a", str(demo_copy(tmp_path / "a")), str(tmp_path / "out"), 1, SHORT_RUN)
    started, lines = schedule._started, []

    def killed_once(given):
        process = started(given)
        if not lines:
            os.kill(process.pid, signal.SIGKILL)
        return process

    monkeypatch.setattr(schedule, "_started", killed_once)
    assert run_local([job], 1, lines.append) == {}
    assert lines[0].startswith("a: lost") and lines[-1] == "a: done" and result_file(job, 0).is_file()
    monkeypatch.setattr(schedule, "ATTEMPTS", 1)
    lines.clear()
    result_file(job, 0).unlink()
    assert "-9" in run_local([job], 1, lines.append)["a"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_that_loses_a_worker_makes_the_same_table(tmp_path, finished_benchmark):
    distributed = pytest.importorskip("distributed")
    jobs = [SequenceJob(n, str(demo_copy(tmp_path / "root" / n)), str(tmp_path / "out" / n), 1, SHORT_RUN) for n in ("a", "b")]
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        lines = []

        def tell(line):
            lines.append(line)

        killer = subprocess.Popen([sys.executable, "-c", f"import os, time; time.sleep(2.5); os.kill({victim}, 9)"])
        assert schedule.run_dask(jobs, cluster.scheduler_address, 2, tell) == {}
        killer.wait()
    assert sorted(lines) == ["a: done", "b: done"]
    local = finished_benchmark[1][0]
    for job in jobs:
        assert run_sequence(job)[0]["ate"] == local["ate"]


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")

    def refused(address, timeout):
        raise OSError(address)

    monkeypatch.setattr(distributed, "Client", refused)
    job = SequenceJob("a", str(DEMO), str(tmp_path), 1)
    with pytest.raises(InputError, match="nobody answers"):
        schedule.run_jobs([job], "tcp://127.0.0.1:1", 1, print)


def test_failures_are_named_after_the_others_are_done(monkeypatch):
    monkeypatch.setattr(schedule, "run_local", lambda *_: {"a": "a: broken", "b": "ended with -9"})
    with pytest.raises(Vitamin3dError, match="a: broken; b: ended with -9"):
        schedule.run_jobs([], None, 1, print)
