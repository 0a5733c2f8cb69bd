# SPDX-License-Identifier: Apache-2.0
"""What `vitamin3d reconstruct` says while it runs and when it is done."""

import json
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scenes import DEMO

from vitamin3d.cli import main
from vitamin3d.commands.reconstruct import _tell_gaps
from vitamin3d.run_gaps import Cause, Gap

GAP = Gap(3, 9, 10**9, 2 * 10**9, 7, Cause.PLAIN, "frames 3–9 (0.1–0.3 s): lost on a plain wall", "step back")


def outcome(gaps, localised, interrupted=False):
    stats = {"tracked_frames": localised, "frames": 100}
    return SimpleNamespace(stats=stats, gaps=gaps, record=SimpleNamespace(interrupted=interrupted), atlas=SimpleNamespace(notes=[]))


def test_few_frames_that_are_not_localised_are_named(capsys):
    _tell_gaps(outcome([GAP], 93))
    told = capsys.readouterr()
    assert told.out == "not localised:\n  frames 3–9 (0.1–0.3 s): lost on a plain wall\n" and told.err == ""
    _tell_gaps(outcome([], 100))
    assert capsys.readouterr().out == ""


def test_many_are_a_warning_unless_the_user_stopped(capsys):
    _tell_gaps(outcome([GAP], 80))
    told = capsys.readouterr()
    assert told.out == "" and told.err.splitlines() == [
        "warning: only 80 of 100 frames are localised",
        "  frames 3–9 (0.1–0.3 s): lost on a plain wall",
        "  13 frames could not be read or were not reached",
        "  what to do about the longest: step back",
    ]
    _tell_gaps(outcome([GAP], 80, interrupted=True))
    told = capsys.readouterr()
    assert told.out.startswith("not localised:\n") and told.err == ""


@pytest.mark.parametrize("quiet", [True, False])
def test_what_was_done_to_the_pictures_is_said_once(tmp_path, monkeypatch, capsys, quiet):
    source, out, rng = tmp_path / "in", tmp_path / "out", np.random.default_rng(0)
    source.mkdir()
    for k in range(6):
        cv2.imwrite(str(source / f"{k}.png"), rng.integers(0, 4000, (320, 480)).astype(np.uint16))
    (source / "camera.yaml").write_text((DEMO / "mav0" / "cam0" / "sensor.yaml").read_text())
    monkeypatch.setattr(sys, "argv", ["vitamin3d", "reconstruct", str(source), "-o", str(out), *(["-q"] if quiet else [])])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    err, stats = capsys.readouterr().err, json.loads((out / "stats.json").read_text())
    (remark,) = stats["remarks"]
    assert remark.startswith("16-bit pictures: values up to ") and err.count(remark) == (0 if quiet else 1)
    assert f"no map: {stats['initialization_failure']} (see {out / 'stats.json'})" in err.splitlines()
    (gap,) = stats["not_localised"]
    assert (gap["first_index"], gap["last_index"], gap["num_frames"]) == (0, 5, 6) and stats["first_frame_s"] == 0.0
    page = (out / "report.html").read_text()
    assert f"<h2>No map</h2><p>{stats['initialization_failure']}</p>" in page
    assert "<h2>Frames that are not localised</h2>" in page and gap["remedy"] in page
