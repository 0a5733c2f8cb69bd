# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import pytest

from vitamin3d.progress import ConsoleObserver
from vitamin3d.types import SlamState


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
