# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json

import numpy as np
import pytest
import scenes

from vitamin3d.config import Config

DEMO = str(scenes.DEMO)


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
