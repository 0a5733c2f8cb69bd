# SPDX-License-Identifier: Apache-2.0
"""What `vitamin3d reconstruct` says while it runs and when it is done; its report's tables."""

import json
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scenes import DEMO

from vitamin3d.cli import main
from vitamin3d.commands.reconstruct import _tell_gaps
from vitamin3d.progress import ConsoleObserver
from vitamin3d.run_gaps import Cause, Gap, gaps_table
from vitamin3d.run_report import _sections
from vitamin3d.types import SlamState

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


# --- progress --------------------------------------------------------------------------------------------------------


def slam(state, keyframes, tracks=90):
    return SimpleNamespace(state=state, map=SimpleNamespace(num_keyframes=keyframes), tracks=range(tracks))


def atlas(active, successor=None, left=()):
    maps = [s for s in (*left, active, successor) if s is not None and s.map.num_keyframes]
    return SimpleNamespace(active=active, successor=successor, left=list(left), current=successor or active, ranked=lambda: maps)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (atlas(slam(SlamState.ROTATING, 0)), "rotating, 0 keyframes, 90 tracks"),
        (atlas(slam(SlamState.UNCERTAIN, 12)), "uncertain, 12 keyframes, 90 tracks"),
        (atlas(slam(SlamState.TRACKING, 8), left=[slam(SlamState.LOST, 30)]), "tracking, 2 maps, the newest with 8 keyframes, 90 tracks"),
        (
            atlas(slam(SlamState.LOST, 30), slam(SlamState.INITIALIZING, 0)),
            "lost, the map kept; the next one: initializing, 0 keyframes, 90 tracks",
        ),
        (
            atlas(slam(SlamState.ROTATING, 9), slam(SlamState.TRACKING, 3), [slam(SlamState.LOST, 30)]),
            "rotating, 2 maps kept; the next one: tracking, 3 keyframes, 90 tracks",
        ),
    ],
)
def test_progress_tells_states_and_maps(capsys, found, words):
    with ConsoleObserver(quiet=False) as observer:
        observer.frame_done(10, 10, found)
    assert capsys.readouterr().err.splitlines() == [f"tracking and mapping: 10 of 10, {words}, 0 s left"]


# --- the report ------------------------------------------------------------------------------------------------------


def test_sections_of_the_report():
    entry = {"folder": ".", "frames": 1200, "keyframes": 40, "cloud_points": 5000, "scale": {"known": False}}
    maps = [entry | {"number": 1, "first_frame_s": 1012.0, "last_frame_s": 1020.5}]
    assert _sections({"maps": maps, "not_localised": [], "first_frame_s": 1000.0}) == []
    maps.append(entry | {"number": 2, "folder": "maps/2", "first_frame_s": 1000.5, "last_frame_s": 1003.0})
    first, second = _sections({"maps": maps, "not_localised": gaps_table([GAP]), "first_frame_s": 1000.0})
    assert "<td>1,200</td><td>12.00</td><td>20.50</td>" in first and "<td>maps/2</td>" in first
    assert "<tr><td>frames 3–9 (0.1–0.3 s)</td><td>lost on a plain wall</td><td>step back</td></tr>" in second
