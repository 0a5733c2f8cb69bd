# SPDX-License-Identifier: Apache-2.0
import pytest
import scenes

from vitamin3d.config import Config, paper_config

DEMO = str(scenes.DEMO)


def test_every_ingredient_changes_the_default(tool):
    variants = tool("ablation").variants()
    assert (variants["default"], variants["paper"]) == (Config(), paper_config())
    assert all(config != Config() for name, config in variants.items() if name != "default")
    prediction = variants["dense flow prediction"].extrema_tracking
    assert (prediction.prediction, prediction.gate_px) == ("dominant_flow", 8.0)


@pytest.mark.slow
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
