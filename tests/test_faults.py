# SPDX-License-Identifier: Apache-2.0
"""A fault put into each step of each way of running: it stops, names the cause, saves what there is, and nothing hangs."""

import json
import os
import sys

import pytest
from scenes import DEMO

from vitamin3d.cli import main
from vitamin3d.commands.process import ONE_THREAD_EACH
from vitamin3d.datasets.base import PictureSequence
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.dense.stages import Meshing
from vitamin3d.dense.volumes import Volumes
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.localization.localizer import Localizer
from vitamin3d.mapping.map_adjustment import MapAdjustment
from vitamin3d.tracking.front_end import FrontEnd

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("time_limit"),
    pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning"),
]
FRAME, KEYFRAME = 100, 1
WAYS = {"live": ["--live"], "live sequential": ["--live", "--sequential"], "threads": [], "sequential": ["--sequential"]}
FAULTS = {
    "reading": (PictureSequence, "read", FRAME, "reading picture 100"),
    "front end": (FrontEnd, "process", FRAME, "curvature and flow of frame 100"),
    "tracking": (Localizer, "locate", FRAME - 30, "tracking and mapping frame"),
    "adjusting": (MapAdjustment, "_solved", KEYFRAME, "mapping"),
    "meshing": (Meshing, "push", KEYFRAME, "meshing"),
    "fusing": (Volumes, "fuse", KEYFRAME, "fusing"),
    "writing": (OutputFolder, "write_view", KEYFRAME, ""),
}
"""What breaks: class, method, at which call, and what the message names."""


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
