# SPDX-License-Identifier: Apache-2.0
import numpy as np

from vitamin3d.geometry.cells import bounds, cell_number, cells_of


def test_bounds():
    points = np.random.default_rng(0).normal(size=(50, 2))
    corner, size = bounds(points)
    np.testing.assert_array_equal(corner, points.min(axis=0))
    np.testing.assert_array_equal(size, np.ptp(points, axis=0))


def test_cells_hold_their_points():
    points = np.random.default_rng(5).uniform(-30, 90, (500, 2))
    cells = cells_of(points, 2.0, 4.0)
    assert sorted(cells.order) == list(range(500)) and cells.side >= 4.0
    assert len(cells.starts) == cells.columns * cells.rows + 1 and cells.starts[-1] == 500
    expected = ((points - points.min(axis=0)) / cells.side).astype(int)
    for column, row in np.ndindex(cells.columns, cells.rows):
        number = cell_number(column, row, cells.columns)
        inside = cells.order[cells.starts[number] : cells.starts[number + 1]]
        np.testing.assert_array_equal(inside, np.flatnonzero((expected == [column, row]).all(axis=1)))
    assert cells_of(np.ones((5, 2)), 2.0).columns == 1
