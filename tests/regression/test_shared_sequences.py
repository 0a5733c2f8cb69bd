# SPDX-License-Identifier: Apache-2.0
"""Real (and one rendered) sequences, which lie beside the checkout and are never part of it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.exporters.mesh import write_ply
from vitamin3d.types import Array, Surface

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"
pytestmark = [pytest.mark.shared, pytest.mark.skipif(not (SHARED / "data").is_dir(), reason="the shared sequences are not here")]


def reconstruct(sequence: str, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vitamin3d.cli", "reconstruct", str(SHARED / "data" / sequence), "-o", str(out), "--quiet", *options]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


def score(what: str, sequence: str, *files: Path) -> dict[str, float]:
    command = [sys.executable, str(SHARED / "score" / "score.py"), what, str(SHARED / "data" / sequence), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


@pytest.mark.slow
@pytest.mark.parametrize(("sequence", "frames", "success", "ate_cm"), [("kitchen", 1000, 0.95, 5.5), ("room1_v101_easy", 300, 0.42, 0.4)])
def test_trajectories(sequence: str, frames: int, success: float, ate_cm: float, tmp_path: Path) -> None:
    done = reconstruct(sequence, tmp_path, "--scale-from-ground-truth", "--max-frames", str(frames))
    assert done.returncode == 0, done.stderr
    result = score("trajectory", sequence, tmp_path / "trajectory.tum")
    assert success <= result["success_rate"] <= 1.0
    assert 0.001 < result["ate_rmse_cm"] < ate_cm


@pytest.mark.parametrize(("sequence", "frames"), [("desk", 300), ("kitti00", 120)])
def test_sequences_without_exact_truth_run_through(sequence: str, frames: int, tmp_path: Path) -> None:
    done = reconstruct(sequence, tmp_path, "--max-frames", str(frames))
    assert done.returncode == 0, done.stderr
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert stats["success_rate"] > 0.8
    assert (tmp_path / "mesh_high.ply").stat().st_size > 100_000


def test_a_drone_that_stands_still_makes_no_map(tmp_path: Path) -> None:
    done = reconstruct("euroc_v101_start", tmp_path)
    assert done.returncode == 3
    assert "no parallax" in done.stderr
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert stats["tracked_frames"] == 0 and stats["keyframes"] == 0
    assert not (tmp_path / "mesh_high.ply").exists()


def evaluate(run: Path, sequence: str, *options: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "vitamin3d.cli", "evaluate", str(run), "-g", str(SHARED / "data" / sequence), "--json", *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


WITH_TRUTH = ["kitchen", "kitti00", "room1_v101_easy", "room1_v103_difficult"]
SURFACE = ("accuracy_median", "accuracy_mean", "accuracy_rmse", "completion_mean", "chamfer")
SHARES = ("accuracy_within_5cm", "completeness_5cm", "completeness_10cm")


@pytest.mark.parametrize("sequence", WITH_TRUTH)
def test_evaluate_agrees_with_the_scorer(sequence: str) -> None:
    """Somebody else's trajectories, by our command and by the independent script."""
    trajectory = SHARED / "peers" / "orbslam3" / sequence / "trajectory.tum"
    found, expected = evaluate(trajectory, sequence), score("trajectory", sequence, trajectory)
    assert found["success_rate"] == pytest.approx(expected["success_rate"], rel=1e-3)
    for name, statistic in (("rmse", "ate_rmse_cm"), ("median", "ate_median_cm"), ("maximum", "ate_max_cm")):
        assert 100 * found["ate"]["Sim(3)"][name] == pytest.approx(expected[statistic], rel=1e-3)
    assert found["scale"] == pytest.approx(expected["scale"], rel=1e-3)


@pytest.mark.parametrize("kind", ["cloud", "mesh"])
@pytest.mark.parametrize("sequence", ["kitchen", "room1_v101_easy", "room1_v103_difficult"])
def test_surfaces_agree_with_the_scorer(sequence: str, kind: str, tmp_path: Path) -> None:
    """Somebody else's points as the cloud of a run, and a mesh of plates on them."""
    theirs = SHARED / "peers" / ("dso" if sequence.startswith("room1") else "orbslam3") / sequence
    file = tmp_path / {"cloud": "cloud.ply", "mesh": "mesh_high.ply"}[kind]
    for name in ("trajectory.tum", "keyframes.tum"):
        shutil.copy(theirs / "trajectory.tum", tmp_path / name)
    (tmp_path / "stats.json").write_text(json.dumps({"frames": 1000, "initialization_retries": 0, "scale": {"known": False, "source": ""}}))
    if kind == "cloud":
        shutil.copy(theirs / "points.ply", file)
    else:
        write_ply(plates(read_geometry(theirs / "points.ply").points), file, [])
    found = evaluate(tmp_path, sequence, "--surface", "--drop-outliers")
    expected = score("surface", sequence, tmp_path / "trajectory.tum", file)
    for figures, unit in ((SURFACE, "_cm"), (SHARES, "")):
        for name in figures:
            assert (100 if unit else 1) * found["surface"][kind]["all"][name] == pytest.approx(expected[name + unit], rel=1e-3), name
    assert found["surface"][kind]["all"]["unobserved"] == pytest.approx(expected["unobserved"], rel=1e-3, abs=1e-4)


def plates(points: Array, side: float = 0.05) -> Surface:
    """A triangle upon each point, all of one direction."""
    corners = np.array([[0.0, 0.0, 0.0], [side, 0.0, 0.0], [0.0, side, 0.0]])
    vertices = (points[:, None] + corners).reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Surface(vertices, triangles, np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), np.full((len(vertices), 3), 128, np.uint8))


def test_the_truth_of_euroc_is_recognised_as_the_bodys() -> None:
    """V1_01's left-camera trajectory against the sequence's own truth, which is of the body."""
    found = evaluate(SHARED / "data" / "euroc_groundtruth" / "V101.tum", "euroc_v101_start")
    assert found["truth"]["frame"] == "body" and found["truth"]["frame_is_certain"]
    assert 0.03 < found["truth"]["uncorrected_rmse"] < 0.06 and found["truth"]["uncorrected_rotation_deg"] > 30
    assert found["alignment"] == "no alignment" and found["ate"]["no alignment"]["rmse"] < 0.05
