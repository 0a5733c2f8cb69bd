# SPDX-License-Identifier: Apache-2.0
"""The tools that score runs, on a made-up run of the demo sequence and on its first frames."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes

from vitamin3d.config import Config, paper_config
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.types import Trajectory

TOOLS = Path(__file__).parents[2] / "tools"
DEMO = str(scenes.DEMO)
FRAMES, STRIDE, SCALE = 60, 2, 0.5


@pytest.fixture(scope="module")
def tool():
    """A tool by its name, loaded once."""
    loaded = {}

    def load(name):
        if name not in loaded:
            spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
            loaded[name] = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
            spec.loader.exec_module(loaded[name])
        return loaded[name]

    yield load
    for name in loaded:
        del sys.modules[name]


def placed(truth, rows, rng=None):
    """The true poses in another world and unit; noise of 1 cm per axis where there is a generator."""
    poses = exp_se3(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.5])) @ truth.T_world_cam[rows]
    poses[:, :3, 3] += 0.01 * rng.standard_normal((len(poses), 3)) if rng is not None else 0.0
    poses[:, :3, 3] *= SCALE
    return Trajectory(truth.timestamps_ns[rows], poses)


def write_tracks(path, demo, frames):
    """Points three metres before the first camera, tracked without error in every second frame."""
    truth, camera, rng = demo.ground_truth(), demo.camera, np.random.default_rng(3)
    points_cam = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), rng.uniform(2.5, 3.5, 50)])
    points = points_cam @ truth.T_world_cam[0, :3, :3].T + truth.T_world_cam[0, :3, 3]
    pixels = [camera.distort(scenes.project(camera, inverse(truth.T_world_cam[k]), points)) for k in frames]
    track_id = np.tile(np.arange(50), len(frames))
    np.savez(path, frame_index=np.repeat(frames, 50), track_id=track_id, pixel=np.concatenate(pixels).astype(np.float32))


@pytest.fixture
def out(demo, tmp_path):
    """A run of every second of the first sixty frames that lost the last one."""
    truth, frames = demo.ground_truth(), np.arange(0, FRAMES, STRIDE)
    assert (truth.timestamps_ns == demo.timestamps_ns).all()
    write_tum(placed(truth, frames[:-1], np.random.default_rng(5)), tmp_path / "trajectory.tum")
    stats = {"frames": len(frames), "initialization_retries": 1, "scale": {"known": False, "source": ""}}
    (tmp_path / "stats.json").write_text(json.dumps(stats))
    write_tracks(tmp_path / "tracks.npz", demo, frames[:12])
    return tmp_path


def test_a_run_is_scored(tool, out, capsys):
    assert tool("evaluate_run").main([str(out), DEMO, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["frames"], found["localised"], found["retries"], found["is_metric"]) == (30, 29, 1, False)
    assert found["success_rate"] == pytest.approx(29 / 30)
    assert (found["truth"]["frame"], found["truth"]["matched"]) == ("camera", 29)
    assert found["scale"] == pytest.approx(1 / SCALE, rel=0.05)
    rmse = {name: errors["rmse"] for name, errors in found["ate"].items()}
    assert 0.01 < rmse["Sim(3)"] < 0.0174  # sqrt(3) cm, less what the alignment takes up
    assert rmse["SE(3)"] > rmse["Sim(3)"] and rmse["scale, first pose"] > rmse["Sim(3)"]
    assert found["rpe"]["1 frame"]["translation"]["count"] == 28 and found["rpe"]["10 frames"]["translation"]["count"] == 19
    assert 0.01 < found["rpe"]["1 frame"]["translation"]["rmse"] < 0.04
    assert found["rpe"]["10 frames"]["rotation_deg"]["maximum"] < 1e-4
    assert "0.1 m travelled" in found["rpe"] and "100 m travelled" not in found["rpe"]


def test_tracks_are_scored_by_the_truth(tool, out, capsys):
    assert tool("evaluate_run").main([str(out), DEMO, "--json"]) == 0
    tracks = json.loads(capsys.readouterr().out)["tracks"]
    assert (tracks["poses"], tracks["num_tracks"], tracks["live_median"], tracks["length_median"]) == ("ground truth", 50, 50, 12)
    ages = {a["age"]: (a["survival"], a["epipolar_inlier_ratio"]) for a in tracks["ages"]}
    assert ages[1] == ages[5] == ages[10] == (1.0, 1.0)
    assert ages[20] == ages[40] == (None, None)


def test_the_table_names_alignment_and_frame(tool, out, capsys):
    assert tool("evaluate_run").main([str(out), DEMO]) == 0
    text = capsys.readouterr().out
    for words in (
        "29 of 30 localised: success rate 96.7 %",
        "after 1 retries",
        "up to scale",
        "of the camera",
        "after Sim(3)",
        "after SE(3)",
    ):
        assert words in text
    assert "after scale, first pose" in text and "poses: ground truth" in text and "10 frames, rotation [deg]" in text


def test_truth_from_files(tool, out, demo, tmp_path, capsys):
    """Another file of the camera; EuRoC's table of the body; the demo's body is its camera."""
    write_tum(demo.ground_truth(), tmp_path / "truth.tum")
    found = []
    for path in (tmp_path / "truth.tum", scenes.DEMO / "mav0" / "state_groundtruth_estimate0" / "data.csv"):
        assert tool("evaluate_run").main([str(out), DEMO, "--json", "--ground-truth", str(path)]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0]["truth"]["origin"].endswith("truth.tum") and "T_BS" in found[1]["truth"]["origin"]
    assert found[0]["ate"]["Sim(3)"]["rmse"] == pytest.approx(found[1]["ate"]["Sim(3)"]["rmse"], abs=1e-8)


def test_without_truth_the_tracks_are_still_scored(tool, out, demo, monkeypatch, capsys):
    module = tool("evaluate_run")
    monkeypatch.setattr(module, "read_truth", lambda *_: None)
    assert module.main([str(out), DEMO, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "ate" not in found and found["tracks"]["poses"] == "the run's own"
    assert module.main([str(out), DEMO]) == 0
    assert "truth    none" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["trajectory.tum", "stats.json"])
def test_an_unfinished_run_is_one_line(tool, out, name, capsys):
    (out / name).unlink()
    assert tool("evaluate_run").main([str(out), DEMO]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("evaluate_run: ") and name in line


@pytest.mark.parametrize(("name", "text"), [("stats.json", "{"), ("stats.json", "[]"), ("stats.json", "{}"), ("tracks.npz", "no")])
def test_damaged_files_are_one_line(tool, out, name, text, capsys):
    (out / name).write_text(text)
    assert tool("evaluate_run").main([str(out), DEMO]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line


def test_missing_sources_and_truths_are_one_line(tool, out, capsys):
    for arguments in ([str(out), "nowhere"], [str(out), DEMO, "--ground-truth", "nowhere.tum"]):
        assert tool("evaluate_run").main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "nowhere" in line


def test_without_tracks_the_rest_is_printed(tool, out, capsys):
    (out / "tracks.npz").unlink()
    assert tool("evaluate_run").main([str(out), DEMO]) == 0
    assert "--save-tracks" in capsys.readouterr().out


def test_a_run_of_other_frames_is_refused(tool, out, capsys):
    late = read_tum(out / "trajectory.tum")
    write_tum(Trajectory(late.timestamps_ns + 10**12, late.T_world_cam), out / "trajectory.tum")
    assert tool("evaluate_run").main([str(out), DEMO]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "three pairs" in line


def test_both_trackers_are_timed(tool, capsys):
    assert tool("benchmark_tracking").main(["--frames", "6", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    steps = found["ours_median_ms"]
    assert set(steps) == {"curvature_extrema", "flow", "predict_climb", "refill", "total"}
    assert found["frames"] == 6 and found["median_points"] > 1000
    assert max(steps["curvature_extrema"], steps["flow"]) < steps["total"]
    assert found["klt_over_ours"] == pytest.approx(found["klt_median_ms"] / steps["total"])


def test_the_benchmark_prints_a_table_in_every_mode(tool, capsys):
    assert tool("benchmark_tracking").main([DEMO, "--frames", "3", "--mode", "paper"]) == 0
    text = capsys.readouterr().out
    assert "OpenCV KLT" in text and "times as long" in text and "3 frames of 480×320" in text


def test_the_benchmark_tracks_as_slam_does(tool, demo):
    """The same tracks as `Slam` has while it has no map."""
    from vitamin3d.slam import Slam
    from vitamin3d.tracking.front_end import FrontEnd
    from vitamin3d.types import SlamState

    tracker, front_end, slam = tool("benchmark_tracking").Tracker(Config()), FrontEnd(Config()), Slam(demo.camera, Config())
    for index in range(5):
        tracker.process(demo.read(index))
        assert slam.process_frame(front_end.process(demo.read(index))) is SlamState.INITIALIZING
    np.testing.assert_array_equal(tracker.tracks.ids, slam.tracks.ids)
    np.testing.assert_array_equal(tracker.tracks.pixels, slam.tracks.pixels)


def test_mistakes_of_the_benchmark_are_one_line(tool, capsys):
    for arguments in (["nowhere"], ["--frames", "0"]):
        assert tool("benchmark_tracking").main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("benchmark_tracking: ")


def test_every_ingredient_changes_the_default(tool):
    variants = tool("ablation").variants()
    assert (variants["default"], variants["paper"]) == (Config(), paper_config())
    assert all(config != Config() for name, config in variants.items() if name != "default")
    prediction = variants["dense flow prediction"].extrema_tracking
    assert (prediction.prediction, prediction.gate_px) == ("dominant_flow", 8.0)


def test_the_ablation_table(tool, tmp_path, capsys):
    page = tmp_path / "ablation.md"
    arguments = [DEMO, "--seeds", "2", "--frames", "45", "--only", "default", "--only", "coasting", "--score-tracks", "--output", str(page)]
    assert tool("ablation").main(arguments) == 0
    told = capsys.readouterr()
    assert told.out.strip() == str(page) and len(told.err.splitlines()) == 4
    rows = [line.strip("| ").split(" | ") for line in page.read_text().splitlines() if line.startswith("|")]
    assert [len(row) for row in rows[2:]] == [11, 11]
    assert rows[2][0] == "**default**" and "coast_frames = 0" in rows[3][0]
    ate, localised, live = (float(rows[2][k].split()[0]) for k in (1, 2, 3))
    assert 0.001 < ate < 1.0 and "±" in rows[2][1] and localised > 90 and live > 1000
    assert float(rows[3][7]) < float(rows[2][7])  # tracks that may not coast die
    assert all(0 < float(cell) <= 1 for row in rows[2:] for cell in row[7:])
    assert "--frames 45" in page.read_text()


def test_a_variant_without_a_map_is_named(tool, capsys):
    """Three frames are too few for a map."""
    assert tool("ablation").main([DEMO, "--seeds", "1", "--frames", "3", "--only", "recovery"]) == 0
    text = capsys.readouterr().out
    assert "– (1 of 1 without map)" in text and "0.0 %" in text


@pytest.mark.parametrize("arguments", [["--only", "magic"], ["--seeds", "0"], ["--frames", "1"], ["--output", "missing/a.md"]])
def test_mistakes_of_the_ablation_are_one_line(tool, arguments, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert tool("ablation").main([DEMO, *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ablation: ")


@pytest.mark.parametrize(("setting", "value"), [("recovery.magic", 1), ("magic.enabled", False), ("window.anchors", "none"), ("seed", 1)])
def test_settings_that_do_not_exist_are_refused(tool, setting, value):
    from vitamin3d.errors import InputError

    with pytest.raises(InputError, match=setting):
        tool("ablation").with_setting(Config(), setting, value)
