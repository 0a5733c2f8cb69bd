# SPDX-License-Identifier: Apache-2.0
"""What tools/benchmark.py prints is what it measured, and mistakes are one line."""

import json
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.config import Config, live_config

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
import benchmark

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A benchmark of the demo's first frames: its JSON."""
    path = tmp_path_factory.mktemp("benchmark") / "new.json"
    assert benchmark.main(["--frames", "90", "--live", "--json", str(path)]) == 0
    return path


@pytest.mark.slow
def test_the_figures_are_those_of_a_run(measured):
    figures = json.loads(measured.read_text())
    assert figures["frames"] == figures["processed_frames"] == 90 and figures["keyframes"] > 4
    assert 1000 < figures["live_points"] < 6000 and figures["unit"] == "metre" and figures["voxels"] == pytest.approx([0.15, 0.025])
    steps = figures["steps"]
    assert steps["curvature_extrema"]["count"] == steps["decoding"]["count"] == 90
    assert steps[benchmark.KLT]["count"] == 89 and steps["fusion_high"]["count"] >= 2
    tracking = figures["rows"]["feature tracking, per frame"]["median_ms"]
    parts = sum(steps[name]["median_ms"] for name in ("curvature_extrema", "flow", "track_extrema", "refill"))
    assert 0.7 * parts < tracking < 1.5 * parts
    assert figures["sparse_cpu_seconds"] > 90 * tracking / 1e3 and figures["dense_cpu_seconds"] > 0


@pytest.mark.slow
def test_tables_and_comparison(measured, capsys):
    figures = json.loads(measured.read_text())
    assert benchmark.main(["--frames", "60", "--live", "--against", str(measured)]) == 0
    said = capsys.readouterr().out
    for words in ("Table 2", "Table 3", "OpenCV KLT, as many points", "against the earlier figures", "peak memory"):
        assert words in said
    slower = {**figures, "steps": {name: {**step, "median_ms": 2 * step["median_ms"]} for name, step in figures["steps"].items()}}
    line = next(line for line in benchmark.comparison(slower, figures).splitlines() if "decoding" in line)
    assert line.split()[-1] == "2.00"


def test_a_loop_goes_back_and_forth(demo):
    looped = benchmark.Looped(demo, 700)
    last = len(demo) - 1
    for index, expected in ((0, 0), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 3, 3)):
        frame = looped.read(index)
        np.testing.assert_array_equal(frame.image, demo.read(expected).image)
        assert frame.index == index and frame.timestamp_ns == index * 50_000_000
    assert len(looped) == 700


@pytest.mark.slow
def test_the_course_of_memory(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "MEMORY_INTERVAL", 50)
    out, plot = tmp_path / "loop.json", tmp_path / "loop.svg"
    assert benchmark.main(["--loop", "200", "--json", str(out), "--plot", str(plot)]) == 0
    figures = json.loads(out.read_text())
    assert [c["frames"] for c in figures["course"]] == [50, 100, 150, 200] and figures["tracked"] > 0.9
    assert all(100 < c["resident_mb"] < 20_000 for c in figures["course"])
    assert xml.fromstring(plot.read_text()).tag.endswith("svg")
    assert json.loads(capsys.readouterr().out)["frames"] == 200
    assert figures["triangles"] == [] and figures["course"][-1]["views"] == 0


@pytest.mark.slow
def test_a_loop_with_both_halves(demo):
    figures = benchmark.loop(demo, 150, live_config(Config()), with_dense=True)
    assert figures["course"][-1]["views"] > 0 and min(figures["triangles"]) > 100


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--frames", "1"], "at least 2"),
        (["/nowhere"], "nowhere"),
        (["--against", "/nowhere.json"], "not a readable JSON"),
        (["--config", "/nowhere.toml"], "not a readable TOML"),
    ],
)
def test_mistakes_are_one_line(arguments, words, capsys):
    assert benchmark.main(arguments) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
