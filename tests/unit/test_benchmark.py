# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d benchmark`: sequences found, trials remembered, killed processes replaced, the paper's tables."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import scenes

from vitamin3d.benchmark import schedule
from vitamin3d.benchmark.published import TABLE_1, euroc_name
from vitamin3d.benchmark.schedule import run_local
from vitamin3d.benchmark.sequences import names_of, sequences_of
from vitamin3d.benchmark.tables import Sequence, figure_4, milliseconds, page, summary, table_1
from vitamin3d.benchmark.trial import SequenceJob, result_file, run_sequence
from vitamin3d.errors import InputError, Vitamin3dError

ROOT = Path(__file__).parents[2]
OPTIONS = ("--max-frames", "45")


def trial(cm=10.0, success=1.0, retries=0, **changes):
    step = {"count": 100, "median_ms": 2.0, "p95_ms": 3.0, "total_seconds": 0.2}
    names = ("track_extrema", "localize", "map", "meshing", "denoising", "fusion_low", "surface_low", "fusion_high", "surface_high")
    series = [[0.0, 0.01, 0.01], [1.0, 0.03, 0.022]]
    fixed = {"frames": 50, "processed_frames": 100, "steps": dict.fromkeys(names, step), "chronological": series}
    return {"ate": {"Sim(3)": cm / 100}, "success_rate": success, "retries": retries, **fixed, **changes}


def demo_copy(folder):
    """The demo as a sequence of that name."""
    return Path(shutil.copytree(scenes.DEMO, folder, ignore=shutil.ignore_patterns("depth0", "scene.ply")))


# --- finding ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("euroc", ["{}/mav0/cam0/data.csv", "{}/mav0/cam0/sensor.yaml"]),
        ("tum", ["{}/rgb.txt"]),
        ("icl", ["{}/associations.txt", "{}/rgb/0.png"]),
        ("7scenes", ["{}/frame-000000.color.png"]),
        ("kitti", ["sequences/{}/times.txt", "sequences/{}/image_0/000000.png"]),
    ],
)
def test_all_sequences_are_found_and_no_others(tmp_path, kind, files):
    for name in ("seq_10", "seq_2", "other"):
        for file in files if name != "other" else ["{}/notes.txt"]:
            path = tmp_path / file.format(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    found = sequences_of(kind, tmp_path)
    assert names_of(found) == ["seq_2", "seq_10"]
    assert sequences_of(kind, found[0]) == [found[0]]
    with pytest.raises(InputError, match=r"no (tum|euroc) sequence"):
        sequences_of("tum" if kind != "tum" else "euroc", tmp_path)


def test_names_differ_even_where_folders_do_not(tmp_path):
    assert names_of([tmp_path / "chess" / "seq-01", tmp_path / "fire" / "seq-01"]) == ["chess_seq-01", "fire_seq-01"]


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("MH_01_easy", "MH01"), ("V2_03_difficult", "V203"), ("MH05", "MH05"), ("v101", "V101"),
        ("room1_v101_easy", None), ("V1_04", None), ("MH_1", "MH01"),
    ],
)  # fmt: skip
def test_only_the_real_sequences_have_published_figures(name, key):
    assert euroc_name(name) == key


def test_published_figures():
    assert len(TABLE_1) == 11 and TABLE_1["V203"]["VITAMIN-E (paper)"].cm == (140.0, 5.2)
    assert TABLE_1["MH04"]["DSO"].success == (95.7, 0.0) and TABLE_1["V103"]["ORB-SLAM"].retries == (56, 26)
    assert all(cells["LSD-SLAM"].retries is None for cells in TABLE_1.values())


# --- tables ----------------------------------------------------------------------------------------------------------


def test_means_and_deviations():
    found = summary([trial(10.0), trial(14.0, 0.98, 3)])
    assert found["cm"] == pytest.approx([12.0, 2.0]) and found["success"] == pytest.approx([99.0, 1.0])
    assert found["retries"] == [1.5, 1.5] and found["is_success"]
    lost = summary([trial(1.0, 0.5), trial(success=0.1, ate={})])
    assert not lost["is_success"] and lost["cm"] == [1.0, 0.0]
    assert summary([trial(ate={}, success=0.0)])["cm"] is None


def test_table_1_has_the_papers_columns_only_for_its_sequences():
    peers = {"orbslam3": {"success_rate": 0.8, "ate": 0.041, "chronological": [[0.0, 0.1], [1.0, 0.2]]}}
    rows = table_1([Sequence("V1_01_easy", [trial(9.7)]), Sequence("kitchen", [trial(3.8, 0.5)], peers)]).splitlines()
    heads, real, other = (row.strip("| ").split(" | ") for k, row in enumerate(rows) if k != 1)
    assert len(heads) == len(real) == len(other) == 7
    assert real[:4] == ["V1_01_easy (50)", "✓ 9.70 ± 0.00 cm, 100.0 ± 0.0 %, 0 ± 0", "–", "✓ 9.7 ± 0.2 cm, 100.0 ± 0.0 %, 0 ± 0"]
    assert other[1].startswith("✗ (3.80 ± 0.00 cm), 50.0") and other[2] == "✗ (4.10 cm), 80.0 %" and other[3] == "–"
    assert "paper" not in table_1([Sequence("kitchen", [trial()])])


def test_table_3_adds_steps_up():
    found = milliseconds([trial(), trial()])
    assert found["feature tracking, per frame"] == pytest.approx(2.0) and found["localisation and mapping, per frame"] == pytest.approx(4.0)
    assert found["meshing and denoising, per keyframe"] == pytest.approx(4.0)
    assert np.isnan(milliseconds([trial(steps={})])["feature tracking, per frame"])


def test_the_page_and_the_figure():
    peers = {"dso": {"success_rate": 1.0, "ate": 0.1, "chronological": [[0.0, 0.1], [1.0, 0.2]]}}
    sequence = Sequence("V1_01_easy", [trial(), trial()], peers)
    text = page("euroc", [sequence], "default settings")
    assert "2 trials per sequence" in text and "| VITAMIN-E (paper) |" in text and "4000" in text and "fig4_V1_01_easy.svg" in text
    assert figure_4(sequence).count("<polyline") == 3 and "dso" in figure_4(sequence)


# --- trials ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A benchmark of one short sequence, two trials."""
    folder = tmp_path_factory.mktemp("benchmark")
    job = SequenceJob("V1_01_easy", str(demo_copy(folder / "root" / "V1_01_easy")), str(folder / "out" / "V1_01_easy"), 2, OPTIONS)
    return job, run_sequence(job)


def test_trials_are_scored_and_lightened(finished):
    job, results = finished
    assert [r["seed"] for r in results] == [0, 1] and all(r["frames"] == 45 and r["exit_code"] == 0 for r in results)
    assert all(1e-5 < r["ate"]["Sim(3)"] < 0.01 and r["success_rate"] > 0.9 for r in results)
    assert len(results[0]["chronological"]) > 30
    kept = {path.name for path in (Path(job.folder) / "trial_0").rglob("*") if path.is_file()}
    assert {"trajectory.tum", "stats.json", "mesh_high.ply", "report.html", "canvas.yaml"} <= kept
    assert "mesh_high.obj" not in kept and not [name for name in kept if name.endswith(".png")]
    assert not (Path(job.folder) / "trial_1" / "mesh_high.ply").exists()


def test_a_trial_without_a_surface_is_scored(tmp_path):
    (tmp_path / "strict.toml").write_text("[surface]\nmin_component_triangles = 100000000\n")
    options = (*OPTIONS, "--config", str(tmp_path / "strict.toml"))
    (result,) = run_sequence(SequenceJob("a", str(demo_copy(tmp_path / "a")), str(tmp_path / "out"), 1, options))
    assert result["exit_code"] == 1 and 1e-5 < result["ate"]["Sim(3)"] < 0.01


def test_finished_trials_are_not_run_again_and_broken_files_are(finished, monkeypatch):
    job, results = finished
    times = [result_file(job, seed).stat().st_mtime_ns for seed in range(2)]
    assert run_sequence(job) == results
    assert [result_file(job, seed).stat().st_mtime_ns for seed in range(2)] == times
    calls = []
    monkeypatch.setattr("vitamin3d.benchmark.trial._run", lambda job, seed: calls.append(seed) or {})
    whole = result_file(job, 1).read_text()
    result_file(job, 1).write_text(whole[:100])
    run_sequence(job)
    result_file(job, 1).write_text(whole)
    run_sequence(SequenceJob(job.name, job.source, job.folder, 3, OPTIONS))
    run_sequence(SequenceJob(job.name, job.source, job.folder, 1, ("--max-frames", "44")))
    assert calls == [1, 2, 0]


def test_the_command_goes_on_and_writes_the_tables(finished, command, tmp_path):
    job, results = finished
    out, peer = Path(job.folder).parent, tmp_path / "peers" / "orbslam3" / "V1_01_easy"
    peer.mkdir(parents=True)
    ours = (out / "V1_01_easy" / "trial_0" / "trajectory.tum").read_text()
    last = ours.splitlines()[-1].split()
    later = "".join(f"{float(last[0]) + 0.1 * k:.9f} {50 * k} 0 {' '.join(last[3:])}\n" for k in range(1, 50))
    (peer / "CameraTrajectory.txt").write_text(ours + later)  # it saw more pictures, and erred there
    told = command("benchmark", "euroc", Path(job.source).parent, "-o", out, "--trials", "2", *OPTIONS, "--peers", tmp_path / "peers")
    assert told.code == 0, told.err
    assert "orbslam3 (measured)" in told.out and "140.0" not in told.out and "9.7 ± 0.2 cm" in told.out
    report = json.loads((out / "benchmark.json").read_text())["sequences"]["V1_01_easy"]
    assert report["ours"]["cm"][0] == pytest.approx(np.mean([100 * r["ate"]["Sim(3)"] for r in results]))
    assert report["peers"]["orbslam3"]["ate"] == pytest.approx(results[0]["ate"]["Sim(3)"], rel=1e-6)
    assert report["peers"]["orbslam3"]["success_rate"] == pytest.approx(results[0]["success_rate"])
    assert (out / "fig4_V1_01_easy.svg").read_text().count("<polyline") == 3


def test_mistakes_are_one_line(command, tmp_path):
    assert "nowhere" in command("benchmark", "euroc", tmp_path / "nowhere", "-o", tmp_path / "out").error
    assert "no kitti sequence" in command("benchmark", "kitti", scenes.DEMO, "-o", tmp_path / "out").error
    broken = demo_copy(tmp_path / "root" / "broken")
    (broken / "mav0" / "cam0" / "sensor.yaml").write_text("intrinsics: [1]\n")
    told = command("benchmark", "euroc", tmp_path / "root", "-o", tmp_path / "out", "--trials", "1")
    assert told.code == 2 and "vitamin3d: broken: " in told.err.splitlines()[-1] and "intrinsics" in told.err


# --- lost processes --------------------------------------------------------------------------------------------------


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


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc")
def test_killed_in_the_middle_and_started_again(tmp_path):
    """The children die with it, and the second start runs only what is missing."""
    for name in ("a", "b"):
        demo_copy(tmp_path / "root" / name)
    arguments = [sys.executable, "-m", "vitamin3d.cli", "benchmark", "euroc", str(tmp_path / "root"), "-o", str(tmp_path / "out")]
    arguments += ["--trials", "1", *OPTIONS]
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


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc")
def test_a_lost_process_is_replaced(tmp_path, monkeypatch):
    job = SequenceJob("a", str(demo_copy(tmp_path / "a")), str(tmp_path / "out"), 1, OPTIONS)
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
def test_a_dask_cluster_that_loses_a_worker_makes_the_same_table(tmp_path, finished):
    distributed = pytest.importorskip("distributed")
    jobs = [SequenceJob(n, str(demo_copy(tmp_path / "root" / n)), str(tmp_path / "out" / n), 1, OPTIONS) for n in ("a", "b")]
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        lines = []

        def tell(line):
            lines.append(line)

        killer = subprocess.Popen([sys.executable, "-c", f"import os, time; time.sleep(2.5); os.kill({victim}, 9)"])
        assert schedule.run_dask(jobs, cluster.scheduler_address, 2, tell) == {}
        killer.wait()
    assert sorted(lines) == ["a: done", "b: done"]
    local = finished[1][0]
    for job in jobs:
        assert run_sequence(job)[0]["ate"] == local["ate"]


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")

    def refused(address, timeout):
        raise OSError(address)

    monkeypatch.setattr(distributed, "Client", refused)
    job = SequenceJob("a", str(scenes.DEMO), str(tmp_path), 1)
    with pytest.raises(InputError, match="nobody answers"):
        schedule.run_jobs([job], "tcp://127.0.0.1:1", 1, print)


def test_failures_are_named_after_the_others_are_done(monkeypatch):
    monkeypatch.setattr(schedule, "run_local", lambda *_: {"a": "a: broken", "b": "ended with -9"})
    with pytest.raises(Vitamin3dError, match="a: broken; b: ended with -9"):
        schedule.run_jobs([], None, 1, print)
