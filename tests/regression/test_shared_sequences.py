# SPDX-License-Identifier: Apache-2.0
"""Real (and one rendered) sequences, which lie beside the checkout and are never part of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

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
