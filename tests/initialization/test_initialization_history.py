# SPDX-License-Identifier: Apache-2.0
"""The frames before there is a map."""

import dataclasses

import numpy as np
from scenes import view_of

from vitamin3d.config import InitializationConfig
from vitamin3d.initialization.initialization_history import InitializationHistory, shared_tracks

CONFIG = InitializationConfig()


def test_shared_tracks_are_paired_by_id():
    rows_a, rows_b = shared_tracks(view_of(0, [5, 3, 8]), view_of(1, [8, 1, 5]))
    assert sorted(zip(rows_a.tolist(), rows_b.tolist(), strict=True)) == [(0, 2), (2, 0)]


def test_the_reference_stays_while_enough_tracks_live():
    history = InitializationHistory(dataclasses.replace(CONFIG, min_surviving_ratio=0.4))
    for k in range(13):
        history.append(view_of(k, range(k, 20 + k)))  # one of twenty dies per frame
    assert history.reference.frame.index == 0  # 8 of 20 live
    history.append(view_of(13, range(13, 33)))
    assert history.reference.frame.index == 3
    ids, pixels_0, pixels_1 = history.pair()
    np.testing.assert_array_equal(ids, np.arange(13, 23))
    assert (pixels_0 == 3).all() and (pixels_1 == 13).all()
    assert [view.frame.index for view in history.since_reference()] == list(range(3, 14))


def test_the_history_forgets_the_oldest():
    history = InitializationHistory(dataclasses.replace(CONFIG, history=4))
    for k in range(7):
        history.append(view_of(k, range(20)))
    assert [view.frame.index for view in history.views] == [3, 4, 5, 6]
    assert history.reference.frame.index == 3


def test_a_cut_leaves_the_newest_frame_as_reference():
    history = InitializationHistory(CONFIG)
    for k in range(5):
        history.append(view_of(k, range(20)))
    history.append(view_of(5, range(100, 120)))
    assert history.reference.frame.index == 5
    empty = InitializationHistory(CONFIG)
    empty.append(view_of(0, []))
    assert len(empty.pair()[0]) == 0


def test_after_a_failed_try_a_twentieth_more_motion_is_needed():
    history = InitializationHistory(dataclasses.replace(CONFIG, min_motion_px=20.0))
    zeros = np.zeros((5, 2))

    def worth(motion):
        return history.is_worth_a_try(zeros, zeros + np.array([motion, 0.0]))

    assert worth(5.0) and worth(6.0)  # too little for a real try
    assert worth(30.0)
    assert not worth(31.0) and not worth(31.4)
    assert worth(31.6)
    assert not worth(33.0)
