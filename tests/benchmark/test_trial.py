# SPDX-License-Identifier: Apache-2.0
"""Trials are scored and remembered."""

from pathlib import Path

import pytest
from scenes import SHORT_RUN, demo_copy

from vitamin3d.benchmark.trial import SequenceJob, result_file, run_sequence

pytestmark = pytest.mark.slow


def test_trials_are_scored_and_lightened(finished_benchmark):
    job, results = finished_benchmark
    assert [r["seed"] for r in results] == [0, 1] and all(r["frames"] == 45 and r["exit_code"] == 0 for r in results)
    assert all(1e-5 < r["ate"]["Sim(3)"] < 0.01 and r["success_rate"] > 0.9 for r in results)
    assert len(results[0]["chronological"]) > 30
    kept = {path.name for path in (Path(job.folder) / "trial_0").rglob("*") if path.is_file()}
    assert {"trajectory.tum", "stats.json", "mesh_high.ply", "report.html", "canvas.yaml"} <= kept
    assert "mesh_high.obj" not in kept and not [name for name in kept if name.endswith(".png")]
    assert not (Path(job.folder) / "trial_1" / "mesh_high.ply").exists()


def test_a_trial_without_a_surface_is_scored(tmp_path):
    (tmp_path / "strict.toml").write_text("[surface]\nmin_component_triangles = 100000000\n")
    options = (*SHORT_RUN, "--config", str(tmp_path / "strict.toml"))
    (result,) = run_sequence(SequenceJob("a", str(demo_copy(tmp_path / "a")), str(tmp_path / "out"), 1, options))
    assert result["exit_code"] == 1 and 1e-5 < result["ate"]["Sim(3)"] < 0.01


def test_finished_trials_are_not_run_again_and_broken_files_are(finished_benchmark, monkeypatch):
    job, results = finished_benchmark
    times = [result_file(job, seed).stat().st_mtime_ns for seed in range(2)]
    assert run_sequence(job) == results
    assert [result_file(job, seed).stat().st_mtime_ns for seed in range(2)] == times
    calls = []
    monkeypatch.setattr("vitamin3d.benchmark.trial._run", lambda job, seed: calls.append(seed) or {})
    whole = result_file(job, 1).read_text()
    result_file(job, 1).write_text(whole[:100])
    run_sequence(job)
    result_file(job, 1).write_text(whole)
    run_sequence(SequenceJob(job.name, job.source, job.folder, 3, SHORT_RUN))
    run_sequence(SequenceJob(job.name, job.source, job.folder, 1, ("--max-frames", "44")))
    assert calls == [1, 2, 0]
