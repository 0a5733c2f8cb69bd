# SPDX-License-Identifier: Apache-2.0
import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scenes import DEMO

from vitamin3d.config import Config
from vitamin3d.tracking.front_end import FrontEnd

_SPEC = importlib.util.spec_from_file_location("landmark_funnel", Path(__file__).parents[2] / "tools" / "landmark_funnel.py")
funnel = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(funnel)
pytestmark = pytest.mark.slow
REASONS, STAGES, main = funnel.REASONS, funnel.STAGES, funnel.main


@pytest.fixture(scope="module")
def counted():
    return funnel.measure(DEMO, 60, Config())


def test_each_stage_is_a_part_of_the_one_before(counted):
    counts = list(funnel.stages(counted).values())
    assert (np.diff(counts) <= 0).all() and counts[0] > 3000 and counts[-1] > 500
    assert counts[3] == len(counted.slam.map.landmarks)


def test_every_track_that_is_no_more_has_a_reason(counted):
    tracker, slam = counted.tracker, counted.slam
    assert sum(tracker.ends.values()) == tracker.num_born + tracker.second_lives - len(slam.tracks) and tracker.second_lives > 0
    assert tracker.ends[REASONS[1]] > tracker.ends[REASONS[7]] == 0
    assert tracker.ends[REASONS[3]] > 0
    assert funnel.good_per_keyframe(slam) > 200


def test_breaks_of_the_picture_are_accounted_for(demo):
    """A mirrored picture, and a film that is mirrored from one on."""
    front_end, counted = FrontEnd(Config()), funnel.Funnel(demo.camera, Config())
    tracker = counted.tracker
    sources = [*range(34), -34, *range(35, 45), *range(-60, -46)]
    for index, source in enumerate(sources):
        frame = demo.read(abs(source))
        image = frame.image[:, ::-1].copy() if source < 0 else frame.image
        counted.process_frame(front_end.process(dataclasses.replace(frame, index=index, image=image)))
        live, begun, jumped = len(tracker.tracks), tracker.num_born + tracker.second_lives, tracker.ends[REASONS[7]]
        assert sum(tracker.ends.values()) == begun - live, index
        assert (jumped > 0) == (index >= 34)
    assert tracker.second_lives > 1000


def test_the_table_is_printed_and_written(tmp_path: Path, capsys):
    page = tmp_path / "funnel.md"
    assert main([str(DEMO), "--frames", "30", "--output", str(page)]) == 0
    text = page.read_text()
    assert capsys.readouterr().out == text
    assert all(f"| {stage} |" in text for stage in STAGES) and len(text.splitlines()) == 2 + len(STAGES) + 1 + len(REASONS)


def test_mistakes_are_named(tmp_path: Path, capsys):
    assert main([str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert main([str(DEMO), "--frames", "1"]) == 2
    assert "--frames must be at least 2" in capsys.readouterr().err
