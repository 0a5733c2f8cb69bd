# SPDX-License-Identifier: Apache-2.0
"""What all tests share."""

import os
import signal
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
from hypothesis import settings

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "vitamin3d"
LIMIT_SECONDS = 90

settings.register_profile("vitamin3d", max_examples=40, deadline=None, derandomize=True, database=None)
settings.load_profile("vitamin3d")


def pytest_configure():
    """Numba does not see when a function that a kernel inlines changes: the tests' own kernels older than that go, as `_jit.py` does it."""
    newest = max(path.stat().st_mtime for path in PACKAGE.rglob("*.py") if "@inlined" in path.read_text())
    for index in TESTS.rglob("*.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)


@pytest.fixture(autouse=True, scope="session")
def _one_opencv_thread():
    """OpenCV's results do not depend on it, its times do."""
    cv2.setNumThreads(1)


@pytest.fixture
def rng():
    return np.random.default_rng(20190616)


@pytest.fixture(scope="session")
def scene():
    """Eight cameras, three hundred points, no noise."""
    return scenes.arc_scene(8, 300, np.random.default_rng(1))


@pytest.fixture(scope="session")
def demo():
    from vitamin3d.datasets import open_dataset

    return open_dataset(scenes.DEMO)


@pytest.fixture(scope="session")
def compiled_kernels():
    """For tests that give processes of their own so much time: on a fresh checkout compiling takes longer than what they do."""
    from vitamin3d.config import Config
    from vitamin3d.warmup import warm_up

    warm_up([Config()])


@pytest.fixture(scope="session")
def finished_benchmark(tmp_path_factory):
    """A benchmark of one short sequence, two trials."""
    from vitamin3d.benchmark.trial import SequenceJob, run_sequence

    folder = tmp_path_factory.mktemp("benchmark")
    source, out = scenes.demo_copy(folder / "root" / "V1_01_easy"), folder / "out" / "V1_01_easy"
    job = SequenceJob("V1_01_easy", str(source), str(out), 2, scenes.SHORT_RUN)
    return job, run_sequence(job)


@pytest.fixture
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


class Told:
    """What a command said and how it ended."""

    def __init__(self, code, out, err):
        self.code, self.out, self.err = code, out, err

    @property
    def error(self):
        """The one line of a refusal."""
        (line,) = self.err.splitlines()
        assert self.code == 2 and line.startswith("vitamin3d: ") and self.out == "", (self.code, self.err)
        return line


@pytest.fixture
def command(monkeypatch, capsys):
    """Runs the console script in this process."""
    from vitamin3d.cli import main
    from vitamin3d.commands.process import ONE_THREAD_EACH

    for name in (*ONE_THREAD_EACH, "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, os.environ.get(name, "1" if name != "OMP_WAIT_POLICY" else "passive"))

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["vitamin3d", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return Told(caught.value.code or 0, out, err)

    return run
