# SPDX-License-Identifier: Apache-2.0
"""Frames that are in no map: which, why, what to do; and what a run says about them."""

import json

import numpy as np
import pytest

from vitamin3d.run_gaps import Cause, find_gaps, gap_rows, gaps_table, longest_told, no_map_sentence, warning
from vitamin3d.types import FrameNote, SlamState

WIDTH, START_NS, STEP_NS = 640, 10**18, 33_333_333
STILL = "no parallax: the picture moved by 0.1 px, 18 px are needed"
SLOW = "no parallax: the picture moved by 9.4 px, 18 px are needed"
TURN = "no parallax: 0.05° in the median, the camera turns but does not travel"
FEW = "too few features: 0 tracks, 100 are needed"
RIGID = "the motion is not that of a rigid scene: only 31 % of the tracks agree"
LOST = {"state": SlamState.LOST}
INITIALIZING = {"state": SlamState.INITIALIZING, "map_number": 1}
DARK = {**INITIALIZING, "brightness": 3.0, "contrast": 1.5, "continues": False, "num_extrema": 2}
PLAIN = {**LOST, "num_extrema": 149}
CUT = {**INITIALIZING, "continues": False, "motion_px": 0.0, "reason": STILL}
STANDING = {**INITIALIZING, "reason": STILL, "motion_px": 0.1}
TURNING, WAITING = {**INITIALIZING, "reason": TURN}, {**INITIALIZING, "reason": SLOW}
SEEN = {"state": SlamState.TRACKING, "seen": True}


def note(index, **given):
    """Of a frame that is lost without any reason, but for what is given."""
    usual = {"state": SlamState.LOST, "map_number": 0, "num_extrema": 2000, "num_tracks": 900, "contrast": 40.0, "brightness": 120.0}
    usual |= {"continues": index > 0, "motion_px": 3.0, "reason": ""}
    return FrameNote(index=index, timestamp_ns=START_NS + index * STEP_NS, **(usual | given))


def run(*stretches, maps=1):
    """Notes and the time stamps of the maps, from stretches (number of frames, what differs in a note)."""
    notes, seen = [], []
    for count, given in stretches:
        for _ in range(count):
            notes.append(note(len(notes), **{name: value for name, value in given.items() if name != "seen"}))
            seen += [notes[-1].timestamp_ns] if given.get("seen") else []
    return notes, [np.array(part, np.int64) for part in np.array_split(seen, maps)]


def gaps_of(*stretches, **options):
    return find_gaps(*run(*stretches, **options), WIDTH)


@pytest.mark.parametrize(
    ("given", "cause", "words"),
    [
        (DARK, Cause.DARK, "too dark"),
        (LOST | {"contrast": 1.9}, Cause.COVERED, "covered lens or an empty wall"),
        (LOST | {"contrast": 4.0, "continues": False}, Cause.COVERED, "covered lens or an empty wall"),
        (CUT, Cause.OTHER_PICTURE, "of something else: a cut"),
        (PLAIN, Cause.PLAIN, "lost on a plain wall"),
        (LOST | {"motion_px": 52.0}, Cause.FAST, "fast motion or blur"),
        (INITIALIZING | {"state": SlamState.ROTATING}, Cause.TURNING, "turns but does not travel"),
        (TURNING, Cause.TURNING, "turns but does not travel"),
        (STANDING, Cause.STANDING, "stands still"),
        ({"state": SlamState.TRACKING, "map_number": 1}, Cause.TOO_SHORT, "lost when young"),
        (INITIALIZING | {"reason": RIGID}, Cause.MOVING, "moves by itself"),
        (LOST, Cause.LOST, "landmarks were not found again"),
        (WAITING, Cause.LOST, "landmarks were not found again"),
    ],
)
def test_each_cause_by_its_name(given, cause, words):
    (gap,) = gaps_of((20, SEEN), (8, given), (20, SEEN))
    assert (gap.first_index, gap.last_index, gap.num_frames, gap.cause) == (20, 27, 8, cause)
    assert (gap.first_ns, gap.last_ns) == (START_NS + 20 * STEP_NS, START_NS + 27 * STEP_NS)
    assert gap.sentence.startswith("frames 20–27 (0.7–0.9 s): ") and words in gap.sentence
    assert gap.remedy and "--start" not in gap.remedy


@pytest.mark.parametrize(
    ("given", "cause"),
    [
        (LOST | {"contrast": 2.0}, Cause.LOST),
        (LOST | {"contrast": 3.0, "brightness": 16.0}, Cause.LOST),
        (LOST | {"contrast": 4.0, "brightness": 3.0}, Cause.LOST),
        (LOST | {"num_extrema": 150}, Cause.LOST),
        (LOST | {"motion_px": 51.0}, Cause.LOST),
    ],
)
def test_just_not(given, cause):
    assert [gap.cause for gap in gaps_of((20, SEEN), (8, given))] == [cause]


def test_the_sentences_of_many_frames_and_of_one():
    several, one = gaps_of((3, SEEN), (4, PLAIN), (2, SEEN), (1, LOST | {"motion_px": 100.0}), (9, SEEN))
    assert several.sentence == "frames 3–6 (0.1–0.2 s): lost on a plain wall"
    assert one.sentence == "frame 9 (0.3 s): lost in fast motion or blur" and one.num_frames == 1
    (long,) = gaps_of((476, SEEN), (524, PLAIN))
    assert long.sentence == "frames 476–999 (15.9–33.3 s): lost on a plain wall"


def test_frames_of_any_map_are_localised():
    assert gaps_of((30, SEEN), maps=3) == [] == find_gaps([], [], WIDTH) == find_gaps([], [np.zeros(0, np.int64)], WIDTH)
    notes, (first, second) = run((10, SEEN), (3, PLAIN), (10, SEEN), maps=2)
    assert [gap.num_frames for gap in find_gaps(notes, [first, second], WIDTH)] == [3]
    assert [(gap.first_index, gap.last_index) for gap in find_gaps(notes, [first], WIDTH)] == [(10, 22)]


def test_unreadable_frames_do_not_split_a_gap():
    notes, maps = run((4, SEEN), (10, PLAIN), (4, SEEN))
    (gap,) = find_gaps([note for note in notes if note.index not in (7, 8)], maps, WIDTH)
    assert (gap.first_index, gap.last_index, gap.num_frames) == (4, 13, 8)


def test_a_gap_is_split_where_each_part_is_long():
    dark, plain = gaps_of((9, SEEN), (5, DARK), (6, PLAIN), (9, SEEN))
    assert (dark.cause, dark.first_index, dark.last_index) == (Cause.DARK, 9, 13)
    assert (plain.cause, plain.first_index, plain.last_index) == (Cause.PLAIN, 14, 19)


@pytest.mark.parametrize(
    ("stretches", "expected"),
    [
        ([(4, DARK), (6, PLAIN)], [(Cause.PLAIN, 10)]),
        ([(6, DARK), (4, PLAIN)], [(Cause.DARK, 10)]),
        ([(30, PLAIN), (4, DARK), (30, PLAIN)], [(Cause.PLAIN, 64)]),
        ([(4, PLAIN), (1, DARK)] * 20 + [(7, DARK)], [(Cause.PLAIN, 99), (Cause.DARK, 8)]),
        ([(1, PLAIN), (1, DARK), (1, PLAIN)] * 15, [(Cause.PLAIN, 45)]),
    ],
)
def test_else_the_majority_counts(stretches, expected):
    found = gaps_of((9, SEEN), *stretches, (9, SEEN))
    assert [(gap.cause, gap.num_frames) for gap in found] == expected


def test_something_else_at_the_beginning_tells_where_to_start():
    """The other scene becomes a map that is dropped when the cut comes; after it the first frames of the map are not localised."""
    young = {"state": SlamState.TRACKING, "map_number": 0}
    for stretches in ([(30, young)], [(18, INITIALIZING | {"map_number": 0, "reason": SLOW}), (12, young)], [(30, CUT)]):
        (gap,) = gaps_of(*stretches, (1, CUT | SEEN), (119, SEEN | {"map_number": 1}))
        assert (gap.cause, gap.first_index, gap.last_index) == (Cause.OTHER_PICTURE, 0, 29)
        assert gap.remedy.endswith("--start 30")


def test_darkness_at_the_beginning_tells_where_to_start():
    dark, waiting = gaps_of((20, DARK), (6, WAITING), (50, SEEN))
    assert dark.cause is Cause.DARK and dark.remedy.endswith("--start 26")
    assert waiting.sentence == f"frames 20–25 (0.7–0.8 s): no map could begin: {SLOW}" and "sideways" in waiting.remedy


def test_after_a_stray_scene_what_follows_it_is_of_something_else_too():
    (stray,) = gaps_of((20, SEEN), (1, CUT), (6, INITIALIZING | {"reason": STILL, "motion_px": 0.0}), (20, SEEN))
    assert stray.cause is Cause.OTHER_PICTURE and stray.num_frames == 7 and "--start" not in stray.remedy
    lost, other = gaps_of((20, SEEN), (10, LOST), (1, CUT), (9, LOST))
    assert (lost.cause, lost.num_frames, other.cause, other.num_frames) == (Cause.LOST, 10, Cause.OTHER_PICTURE, 10)


def test_frames_that_a_map_was_cut_back_by_are_said_to_be_bent():
    """They were tracked in a map that is kept, and are in it no more."""
    cut_back = {"state": SlamState.TRACKING, "map_number": SEEN.get("map_number", 0)}
    (gap,) = gaps_of((20, SEEN), (12, cut_back), (20, SEEN))
    assert gap.cause is Cause.BENT and gap.num_frames == 12 and "cut back" in gap.sentence and "slower" in gap.remedy


def test_frames_before_a_map_that_was_dropped_belong_to_it():
    dropped = {"state": SlamState.TRACKING, "map_number": 1}
    (gap,) = gaps_of((20, SEEN), (6, WAITING), (6, dropped), (20, SEEN))
    assert gap.cause is Cause.TOO_SHORT and gap.num_frames == 12
    (waited,) = gaps_of((20, SEEN), (6, WAITING), (20, SEEN | {"map_number": 1}))
    assert waited.cause is Cause.LOST


def test_a_standing_start_is_no_other_picture():
    (gap,) = gaps_of((90, STANDING), (90, SEEN))
    assert gap.cause is Cause.STANDING and "--start" not in gap.remedy


def test_no_warning_from_nine_tenths_on():
    stretches = (45, SEEN), (10, PLAIN), (45, SEEN)
    gaps = gaps_of(*stretches)
    assert warning(gaps, 90, 100) == [] == warning([], 0, 0) and warning(gaps, 89, 100) != []


def test_the_warning_names_the_longest_stretches_and_the_remedy_of_the_longest():
    gaps = gaps_of((10, SEEN), (2, LOST), (10, SEEN), (20, DARK), (10, SEEN), (30, PLAIN), (10, SEEN))
    assert warning(gaps, 40, 95) == [
        "only 40 of 95 frames are localised",
        "frames 10–11 (0.3–0.4 s): lost: the landmarks were not found again",
        "frames 22–41 (0.7–1.4 s): too dark to see anything: darkness or a covered lens",
        "frames 52–81 (1.7–2.7 s): lost on a plain wall",
        "3 frames could not be read or were not reached",
        "what to do about the longest: keep edges and texture in view: step back, or turn to where things stand",
    ]
    assert warning([], 40, 95) == ["only 40 of 95 frames are localised", "55 frames could not be read or were not reached"]


def test_five_stretches_are_told():
    gaps = gaps_of(*[part for count in (3, 9, 1, 8, 7, 2, 6) for part in ((10, SEEN), (count, PLAIN))])
    lines = longest_told(gaps)
    told = "10–12", "23–31", "53–60", "71–77", "100–105"
    assert [line.split(" (")[0] for line in lines] == [*(f"frames {where}" for where in told), *lines[5:]]
    assert lines[5:] == ["and 2 more: see stats.json"]
    assert longest_told(gaps[:5]) == [gap.sentence for gap in gaps[:5]] and longest_told([]) == []


def test_pictures_out_of_order_are_called_so():
    notes, maps = run((19, SEEN), *[(1, CUT), (1, LOST)] * 20)
    first, *_, told, last = warning(find_gaps(notes, maps, WIDTH), 19, 59, notes)
    assert first.startswith("only 19 of 59 ") and "--start" not in last
    assert told.startswith("the pictures look out of order or do not overlap: 20 of 59 continue no earlier one; give ")
    for other in ([(20, CUT), (20, LOST)], [(40, DARK)]):
        notes, maps = run((20, SEEN), *other)
        assert not any("out of order or do not overlap" in line for line in warning(find_gaps(notes, maps, WIDTH), 20, 60, notes))


def test_a_camera_that_turns_is_called_so():
    notes, maps = run((40, TURNING), (20, SEEN))
    line = "the camera turns without travelling in 40 of 60 frames: no depth can be had from that"
    assert line in warning(find_gaps(notes, maps, WIDTH), 20, 60, notes)
    assert not any("without travelling" in line for line in warning(find_gaps(notes, maps, WIDTH), 20, 80, notes))


@pytest.mark.parametrize(
    ("stretches", "begins", "ends"),
    [
        ([(12, DARK | {"reason": FEW})], f"{FEW}; in all 12 frames: too dark", "lens"),
        ([(12, STANDING)], f"{STILL}; in all 12 frames: the camera stands still", "leave this part out"),
        ([(9, WAITING), (31, TURNING)], f"{TURN} (31 of 40 frames); ", "move sideways while turning"),
        ([(30, INITIALIZING | {"reason": RIGID}), (9, DARK)], f"{RIGID}; in 30 of 39 frames: too much moves by itself", "film without it"),
        ([(9, {"state": SlamState.TRACKING}), (1, LOST)], "in all 10 frames: tracked in a map that was lost when young", "overlap"),
        ([(9, INITIALIZING | {"reason": FEW, "num_extrema": 60})], f"{FEW}; in all 9 frames: lost on a plain wall", "things stand"),
        ([(1, CUT | {"reason": ""})] * 9, "in 8 of 9 frames: of something else", "by two thirds"),
    ],
)
def test_why_a_run_has_no_map(stretches, begins, ends):
    sentence = no_map_sentence(run(*stretches)[0], "of the last frame", WIDTH)
    assert sentence.startswith(begins) and sentence.endswith(ends) and "of the last frame" not in sentence


def test_where_no_cause_prevails_the_commonest_reason_tells():
    kinds = [f"only {k} of 500 tracks lie in front of both cameras" for k in (40, 41, 42)]
    notes, _ = run((3, DARK), *((3, INITIALIZING | {"reason": kind}) for kind in kinds), (4, WAITING))
    assert no_map_sentence(notes, SLOW, WIDTH).startswith(f"{kinds[-1]}; move sideways, slowly")
    assert no_map_sentence(run((5, LOST))[0], "given", WIDTH).startswith("given; ")
    assert no_map_sentence([], "no frame was read", WIDTH) == "no frame was read"


def test_without_a_map_the_whole_run_is_a_gap_and_nothing_is_to_be_started_from():
    (gap,) = gaps_of((30, DARK))
    assert gap.cause is Cause.DARK and gap.num_frames == 30 and "--start" not in gap.remedy
    assert [gap.cause for gap in gaps_of((30, STANDING), (1, CUT), (30, STANDING))] == [Cause.STANDING]


def test_tables_for_json_and_for_the_report():
    gaps = gaps_of((3, SEEN), (4, PLAIN), (2, SEEN), (1, CUT))
    table = json.loads(json.dumps(gaps_table(gaps)))
    assert [(row["first_index"], row["last_index"], row["num_frames"], row["cause"]) for row in table] == [
        (3, 6, 4, "plain"),
        (9, 9, 1, "other picture"),
    ]
    assert table[0] == gaps[0].as_dict() and table[0]["first_ns"] == START_NS + 3 * STEP_NS
    assert [row[:2] for row in gap_rows(table)] == [
        ("frames 3–6 (0.1–0.2 s)", "lost on a plain wall"),
        ("frame 9 (0.3 s)", "of something else: a cut, a stray picture, or pictures out of order or without overlap"),
    ]
    assert [row[2] for row in gap_rows(table)] == [gap.remedy for gap in gaps] and gap_rows([]) == gaps_table([]) == []
