# SPDX-License-Identifier: Apache-2.0
"""The newest frames of a map, each of which continues the one before."""

import pytest
from scenes import view_of

from vitamin3d.initialization import heritage
from vitamin3d.initialization.heritage import Heritage


def indices(kept):
    return [view.frame.index for view in kept.views]


def filled(count, most=60):
    kept = Heritage(most)
    for index in range(count):
        kept.add(view_of(index, [1, 2]), continues=index > 0)
    return kept


def test_the_oldest_comes_first():
    assert indices(filled(4)) == [0, 1, 2, 3]
    assert indices(Heritage(60)) == []


def test_views_are_kept_as_they_are():
    kept, view = Heritage(60), view_of(3, [7])
    kept.add(view, continues=False)
    assert kept.views[-1] is view


def test_of_many_the_newest_are_kept():
    assert indices(filled(9, most=4)) == [5, 6, 7, 8]


def test_what_continues_none_of_them_comes_alone():
    kept = filled(5)
    kept.add(view_of(7, [1]), continues=False)
    kept.add(view_of(8, [1]), continues=True)
    assert indices(kept) == [7, 8]


@pytest.mark.parametrize(("pictures", "expected"), [(3.5, [6, 7, 8]), (1.0, [8]), (0.5, []), (100.0, list(range(9)))])
def test_of_large_pictures_fewer_are_kept(monkeypatch, pictures, expected):
    monkeypatch.setattr(heritage, "MOST_BYTES", pictures * view_of(0, []).frame.num_bytes)
    assert indices(filled(9)) == expected
