# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.benchmark.tables import Sequence, figure_4, milliseconds, page, summary, table_1


def trial(cm=10.0, success=1.0, retries=0, **changes):
    step = {"count": 100, "median_ms": 2.0, "p95_ms": 3.0, "total_seconds": 0.2}
    names = ("track_extrema", "localize", "map", "meshing", "denoising", "fusion_low", "surface_low", "fusion_high", "surface_high")
    series = [[0.0, 0.01, 0.01], [1.0, 0.03, 0.022]]
    fixed = {"frames": 50, "processed_frames": 100, "steps": dict.fromkeys(names, step), "chronological": series}
    return {"ate": {"Sim(3)": cm / 100}, "success_rate": success, "retries": retries, **fixed, **changes}


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
