# SPDX-License-Identifier: Apache-2.0
"""Arrays that grow, and the rows of ids that are never used again, against lists that are searched."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vitamin3d.growing_array import Column, Columns, GrowingArray, IdRows

# --- arrays that grow ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "fill"), [(np.float64, np.nan), (np.float64, 0.0), (np.int64, -1), (np.int32, 0), (np.bool_, False)])
@pytest.mark.parametrize("shape", [(), (2,), (4, 4)])
def test_what_nobody_wrote_holds_the_fill_value(dtype, fill, shape):
    array = GrowingArray(shape, dtype, fill)
    assert array.size == 0 and array.view.shape == (0, *shape) and array.view.dtype == dtype
    for size in (3, 1024, 1025, 9000):
        array.resize(size)
        assert array.view.dtype == dtype
        np.testing.assert_array_equal(array.view, np.full((size, *shape), fill, dtype))


def test_it_never_shrinks():
    array = GrowingArray((), np.int64, -1)
    array.append(np.arange(5))
    array.resize(2)
    np.testing.assert_array_equal(array.view, np.arange(5))


def test_the_view_is_the_array_itself():
    array = GrowingArray((2,), np.float64, 0.0)
    array.resize(3)
    array.view[1] = [4.0, 5.0]
    array.append(np.full((2000, 2), 7.0))
    np.testing.assert_array_equal(array.view[:4], [[0, 0], [4, 5], [0, 0], [7, 7]])


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 1500)), max_size=8))
def test_it_is_a_list_that_is_filled_up(steps):
    array, twin = GrowingArray((), np.int64, -1), []
    for is_appended, number in steps:
        if is_appended:
            array.append(np.arange(number))
            twin += range(number)
        else:
            array.resize(number)
            twin += [-1] * (number - len(twin))
        assert array.size == len(twin)
        np.testing.assert_array_equal(array.view, twin)


class Table(Columns):
    """Two columns, and an attribute that is none."""

    pixels = Column((2,), np.float64, np.nan)
    counts = Column((), np.int32, 0)
    names = ("pixels", "counts")


def test_a_column_reads_as_the_used_part_of_its_array():
    table = Table()
    assert set(table.columns) == set(Table.names) and table.pixels.shape == (0, 2) and table.counts.dtype == np.int32
    table.columns["counts"].append(np.arange(3))
    table.columns["pixels"].resize(2)
    np.testing.assert_array_equal(table.counts, [0, 1, 2])
    assert table.pixels.shape == (2, 2) and np.isnan(table.pixels).all()
    table.counts[1] = 9
    np.testing.assert_array_equal(table.columns["counts"].view, [0, 9, 2])


def test_two_tables_share_nothing():
    one, other = Table(), Table()
    one.columns["counts"].append(np.arange(3))
    assert len(other.counts) == 0


# --- rows of ids -----------------------------------------------------------------------------------------------------


class Remembered:
    """The ids in a list, row by row: those that were kept when something was last forgotten, then all that are newer than the last kept."""

    def __init__(self, first_id):
        self.by_row, self.first_new, self.next = [], first_id, first_id

    def give_birth(self, count):
        self.by_row += range(self.next, self.next + count)
        self.next += count

    def keep(self, ids):
        self.first_new = ids[-1] + 1 if ids else self.first_new
        self.by_row = [*ids, *range(self.first_new, self.next)]

    def rows(self):
        """By id."""
        return {id_: row for row, id_ in enumerate(self.by_row)}


def check(rows, twin):
    every_id, by_row = np.arange(twin.next), twin.rows()
    np.testing.assert_array_equal(rows.of(every_id), [by_row.get(id_, -1) for id_ in range(twin.next)])
    np.testing.assert_array_equal(rows.ids(np.arange(len(twin.by_row))), twin.by_row)


@given(st.integers(0, 30), st.lists(st.tuples(st.integers(0, 12), st.floats(0, 1)), max_size=9), st.randoms(use_true_random=False))
def test_rows_are_the_places_in_a_list_of_what_is_remembered(first_id, steps, random):
    rows, twin = IdRows(first_id), Remembered(first_id)
    for num_born, share in steps:
        twin.give_birth(num_born)
        check(rows, twin)
        ids = [id_ for id_ in twin.by_row if random.random() < share]
        rows = rows.keeping(np.array(ids, np.int64))
        twin.keep(ids)
        check(rows, twin)
        assert rows.old.tolist() == ids


def test_a_forgotten_id_has_no_row_and_its_row_goes_to_another():
    rows = IdRows().keeping(np.array([2, 5, 9]))
    np.testing.assert_array_equal(rows.of(np.array([0, 2, 3, 5, 8, 9, 10, 12])), [-1, 0, -1, 1, -1, 2, 3, 5])
    np.testing.assert_array_equal(rows.ids(np.array([5, 0, 3, 2])), [12, 2, 10, 9])


def test_what_was_forgotten_once_stays_forgotten():
    rows = IdRows().keeping(np.array([2, 5, 9])).keeping(np.array([5, 20]))
    np.testing.assert_array_equal(rows.of(np.array([2, 3, 5, 9, 20, 21])), [-1, -1, 0, -1, 1, 2])


def test_ids_from_before_the_first_have_no_row():
    np.testing.assert_array_equal(IdRows(100).of(np.array([0, 99, 100, 107])), [-1, -1, 0, 7])
    nothing_kept = IdRows(100).keeping(np.array([103])).keeping(np.zeros(0, np.int64))
    np.testing.assert_array_equal(nothing_kept.of(np.array([99, 100, 103, 104])), [-1, -1, -1, 0])


def test_neither_the_ids_asked_for_nor_the_rows_before_are_changed():
    before = IdRows().keeping(np.array([4, 6]))
    ids, rows = np.array([4, 5, 7]), np.array([0, 2])
    before.of(ids), before.ids(rows)
    after = before.keeping(np.array([6]))
    np.testing.assert_array_equal(ids, [4, 5, 7])
    np.testing.assert_array_equal(rows, [0, 2])
    np.testing.assert_array_equal(before.of(ids), [0, -1, 2])
    np.testing.assert_array_equal(after.of(ids), [-1, -1, 1])


def test_of_no_ids_there_are_no_rows():
    for rows in (IdRows(), IdRows(7), IdRows().keeping(np.array([3]))):
        assert rows.of(np.zeros(0, np.int64)).shape == rows.ids(np.zeros(0, np.int64)).shape == (0,)
