# SPDX-License-Identifier: Apache-2.0
"""Which frames of a run are in no map, why, and what to do about it: plain words for the console, `stats.json` and `report.html`."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from itertools import groupby
from typing import Any

import numpy as np

from vitamin3d.types import Array, FrameNote, SlamState

DARK_BRIGHTNESS, DARK_CONTRAST = 16.0, 4.0
EMPTY_CONTRAST, NOISE_CONTRAST = 2.0, 5.0
"""Grey levels; less than the second is but noise where the picture does not even continue another."""
PLAIN_EXTREMA = 150
FAST_SHARE, STILL_SHARE = 0.08, 0.001
"""Of the picture's width, from one frame to the next."""
MIN_PART = 5
"""Frames; a gap is not split into shorter ones."""
MOST_TOLD = 5
"""Gaps that the console names; files have all."""
ENOUGH, DISORDER, TELLING = 0.9, 1 / 3, 1 / 3
"""Shares of frames: to be localised; breaks, from which on pictures look out of order; of a cause that explains a run without a map."""


class Cause(Enum):
    """Why a frame is not localised."""

    DARK = "dark"
    COVERED = "covered"
    OTHER_PICTURE = "other picture"
    PLAIN = "plain"
    FAST = "fast"
    TURNING = "turning"
    STANDING = "standing"
    TOO_SHORT = "too short"
    BENT = "bent"
    MOVING = "moving"
    LOST = "lost"


RULES: dict[Cause, Callable[[FrameNote, float], bool]] = {
    Cause.DARK: lambda note, _: note.brightness < DARK_BRIGHTNESS and note.contrast < DARK_CONTRAST,
    Cause.COVERED: lambda note, _: note.contrast < (EMPTY_CONTRAST if note.continues else NOISE_CONTRAST),
    Cause.OTHER_PICTURE: lambda note, _: not note.continues,
    Cause.PLAIN: lambda note, _: note.num_extrema < PLAIN_EXTREMA,
    Cause.FAST: lambda note, width_px: note.motion_px > FAST_SHARE * width_px,
    Cause.TURNING: lambda note, _: note.state is SlamState.ROTATING or "turns but does not travel" in note.reason,
    Cause.STANDING: lambda note, width_px: "the picture moved by" in note.reason and note.motion_px < STILL_SHARE * width_px,
    Cause.TOO_SHORT: lambda note, _: note.state.is_tracked,
    Cause.MOVING: lambda note, _: "not that of a rigid scene" in note.reason,
    Cause.LOST: lambda *_: True,
}
"""The first that holds, by a frame's note and the picture's width."""
NO_DEPTH = ": no parallax, no depth"
TO_BEGIN = "move sideways, slowly, with texture in view and little that moves by itself"
TO_ORDER = "give pictures in the order in which they were taken, overlapping by two thirds"
TEXTS = {
    Cause.DARK: ("too dark to see anything: darkness or a covered lens", "more light or a longer exposure, and nothing before the lens"),
    Cause.COVERED: ("a picture without contrast: a covered lens or an empty wall", "keep the lens free and something with texture in view"),
    Cause.OTHER_PICTURE: (
        "of something else: a cut, a stray picture, or pictures out of order or without overlap",
        f"leave these pictures out, or {TO_ORDER}",
    ),
    Cause.PLAIN: ("lost on a plain wall", "keep edges and texture in view: step back, or turn to where things stand"),
    Cause.FAST: ("lost in fast motion or blur", "film slower, with more light (a shorter exposure) or more pictures per second"),
    Cause.TURNING: (f"the camera turns but does not travel{NO_DEPTH}", "move sideways while turning"),
    Cause.STANDING: (f"the camera stands still{NO_DEPTH}", "move sideways, or leave this part out"),
    Cause.TOO_SHORT: ("tracked in a map that was lost when young and dropped", "film this part slower and longer, with more overlap"),
    Cause.BENT: (
        "tracked, but the map had bent or hung on too little since, and was cut back to where it was sound",
        "keep things near and far in view in turns and doorways, and film them slower",
    ),
    Cause.MOVING: ("too much moves by itself: the scene is not rigid", "keep what moves small in the picture, or film without it"),
    Cause.LOST: ("lost: the landmarks were not found again", "film slower and with more overlap, or come back to what was seen before"),
}
"""What happened, and what to do."""
SKIPPABLE = (Cause.DARK, Cause.COVERED, Cause.OTHER_PICTURE)
"""What a run had better begin after."""
OF_A_BREAK = (Cause.STANDING, Cause.TOO_SHORT, Cause.LOST)
"""What becomes of frames that are cut off from the map by a picture of something else."""


@dataclass(frozen=True)
class Gap:
    """A stretch of frames that is in no map."""

    first_index: int
    last_index: int
    first_ns: int
    last_ns: int
    num_frames: int
    """Those that were processed."""
    cause: Cause
    sentence: str
    """Which frames, when (since the run's first frame), and why."""
    remedy: str

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"cause": self.cause.value}


def find_gaps(notes: Sequence[FrameNote], localised_ns: Sequence[Array], width_px: float) -> list[Gap]:
    """The stretches of processed frames that no map has, in their order; one of several causes is several where none is short.

    Args:
        notes: of the frames that were processed; unreadable ones are not among them.
        localised_ns: (T,) int64 time stamps of each map.
        width_px: of the pictures.
    """
    in_map = np.isin(np.array([note.timestamp_ns for note in notes], np.int64), np.concatenate([np.zeros(0, np.int64), *localised_ns]))
    causes, begin = _causes_in_time(notes, width_px, in_map), int(in_map.argmax()) if in_map.any() else None
    gaps = []
    for is_localised, rows in groupby(range(len(notes)), key=lambda k: bool(in_map[k])):
        if is_localised:
            continue
        first = next(rows)
        for part in _parts([causes[k] for k in (first, *rows)]):
            gaps.append(_gap(notes, first, first + len(part), _majority(part), begin))
            first += len(part)
    return gaps


def _causes(notes: Sequence[FrameNote], width_px: float) -> list[Cause]:
    """Why each frame would not be localised; that the first continues none says nothing."""
    judged = [*(replace(note, continues=True) for note in notes[:1]), *notes[1:]]
    return [next(cause for cause, holds in RULES.items() if holds(note, width_px)) for note in judged]


def _causes_in_time(notes: Sequence[FrameNote], width_px: float, in_map: Array) -> list[Cause]:
    """As `_causes`, with what only frames before and after tell; `in_map` (N,) says which are localised.

    Where a map began and was dropped, so it was for the frames before it; where it was kept, it was cut back there. After a break, until
    one is localised, frames are of something else; and so are those before the last break that comes before the first map.
    """
    kept = {note.map_number for note, is_in in zip(notes, in_map, strict=True) if is_in}
    dropped = {note.map_number for note in notes if note.state.is_tracked} - kept
    plain, begin = _causes(notes, width_px), int(in_map.argmax()) if in_map.any() else -1
    last_break = max((k for k in range(1, begin + 1) if plain[k] is Cause.OTHER_PICTURE), default=0)
    causes, is_cut_off = [], False
    for k, cause in enumerate(plain):
        is_cut_off = begin >= 0 and not in_map[k] and (is_cut_off or cause is Cause.OTHER_PICTURE)
        if (is_cut_off or k < last_break) and cause in OF_A_BREAK:
            cause = Cause.OTHER_PICTURE
        if cause is Cause.LOST and notes[k].map_number in dropped:
            cause = Cause.TOO_SHORT
        causes.append(Cause.BENT if cause is Cause.TOO_SHORT and notes[k].map_number in kept else cause)
    return causes


def _parts(causes: list[Cause]) -> list[list[Cause]]:
    """The causes of a gap cut where they change; parts that are too short join the one before, the shortest first."""
    parts = [list(run) for _, run in groupby(causes)]
    for size in range(1, MIN_PART):
        joined: list[list[Cause]] = []
        for part in parts:
            if joined and min(len(joined[-1]), len(part)) <= size:
                joined[-1] += part
            else:
                joined.append(part)
        parts = [[cause for part in alike for cause in part] for _, alike in groupby(joined, key=_majority)]
    return parts


def _majority(causes: Iterable[Cause]) -> Cause:
    return Counter(causes).most_common(1)[0][0]


def _gap(notes: Sequence[FrameNote], start: int, stop: int, cause: Cause, begin: int | None) -> Gap:
    """Of the notes from `start` to before `stop`; `begin` is the first that is localised."""
    first, last, (what, remedy) = notes[start], notes[stop - 1], TEXTS[cause]
    if begin is not None and start < begin and cause in SKIPPABLE:
        remedy = f"begin with the first frame that is localised: --start {notes[begin].index}"
    if cause is Cause.LOST and (begin is None or start < begin):
        what = f"no map could begin: {_commonest(note.reason for note in notes[start:stop]) or 'the frames lead to none'}"
        remedy = TO_BEGIN
    t0, t1 = (1e-9 * (note.timestamp_ns - notes[0].timestamp_ns) for note in (first, last))
    where = f"frame {first.index} ({t0:.1f} s)" if stop - start == 1 else f"frames {first.index}–{last.index} ({t0:.1f}–{t1:.1f} s)"
    return Gap(first.index, last.index, first.timestamp_ns, last.timestamp_ns, stop - start, cause, f"{where}: {what}", remedy)


def _commonest(reasons: Iterable[str]) -> str:
    """The last of the kind of reason that occurs most, whatever its numbers; empty for none."""
    by_kind: dict[str, list[str]] = {}
    for reason in filter(None, reasons):
        by_kind.setdefault(re.sub(r"[\d.]+", "#", reason), []).append(reason)
    return max(by_kind.values(), key=len)[-1] if by_kind else ""


def longest_told(gaps: Sequence[Gap]) -> list[str]:
    """A line for each of the longest gaps, in their order, and one for how many more there are."""
    longest = sorted(sorted(gaps, key=lambda gap: -gap.num_frames)[:MOST_TOLD], key=lambda gap: gap.first_index)
    others = len(gaps) - len(longest)
    return [*(gap.sentence for gap in longest), *([f"and {others} more: see stats.json"] if others else [])]


def warning(gaps: Sequence[Gap], num_localised: int, num_frames: int, notes: Sequence[FrameNote] = ()) -> list[str]:
    """Lines about a run of `num_frames` asked for, none where 90 % are localised: the longest gaps; disorder (by notes); turning."""
    if num_localised >= ENOUGH * num_frames:
        return []
    unseen = num_frames - num_localised - sum(gap.num_frames for gap in gaps)
    lines = [f"only {num_localised} of {num_frames} frames are localised", *longest_told(gaps)]
    lines += [f"{unseen} frames could not be read or were not reached"] if unseen > 0 else []
    breaks = sum(cause is Cause.OTHER_PICTURE for cause in _causes(notes, np.inf))
    if breaks > DISORDER * len(notes):
        lines.append(f"the pictures look out of order or do not overlap: {breaks} of {len(notes)} continue no earlier one; {TO_ORDER}")
    turning = sum(gap.num_frames for gap in gaps if gap.cause is Cause.TURNING)
    if 2 * turning > num_frames:
        lines.append(f"the camera turns without travelling in {turning} of {num_frames} frames: no depth can be had from that")
    if gaps:
        lines.append(f"what to do about the longest: {max(gaps, key=lambda gap: gap.num_frames).remedy}")
    return lines


def no_map_sentence(notes: Sequence[FrameNote], reason: str, width_px: float) -> str:
    """Why a whole run has no map, and what to do: the commonest reason and cause of all frames, not the last one's `reason`."""
    causes = _causes_in_time(notes, width_px, np.zeros(len(notes), bool))
    cause = _majority([cause for cause in causes if cause is not Cause.LOST] or [Cause.LOST])
    if causes.count(cause) < TELLING * len(notes):
        cause = Cause.LOST
    count, (text, remedy) = causes.count(cause), TEXTS[cause]
    told = _commonest(note.reason for note, of in zip(notes, causes, strict=True) if of is cause and of is not Cause.TOO_SHORT)
    if cause is Cause.LOST:
        return f"{told or reason}; {TO_BEGIN}" if notes else reason
    share, what = f"all {count}" if count == len(notes) else f"{count} of {len(notes)}", text.removesuffix(NO_DEPTH)
    return f"{told} ({share} frames); {remedy}" if what in told else f"{told + '; ' if told else ''}in {share} frames: {what}; {remedy}"


def gaps_table(gaps: Sequence[Gap]) -> list[dict[str, Any]]:
    """For `stats.json`."""
    return [gap.as_dict() for gap in gaps]


def gap_rows(table: Sequence[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """For `report.html`, of the rows of `gaps_table`: which frames and when, what happened, what to do."""
    return [(where, what, row["remedy"]) for row in table for where, _, what in [row["sentence"].partition(": ")]]
