# SPDX-License-Identifier: Apache-2.0
"""The tools that measure the tracker and the ingredients, on the first frames of the demo sequence."""

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes

from vitamin3d.config import Config, paper_config

TOOLS = Path(__file__).parents[2] / "tools"
DEMO = str(scenes.DEMO)


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
    for index in range(8):
        frame = demo.read(index)
        frame = dataclasses.replace(frame, image=frame.image[:, ::-1].copy()) if index > 5 else frame  # a break of the picture
        tracker.process(frame)
        assert slam.process_frame(front_end.process(frame)) is SlamState.INITIALIZING
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
