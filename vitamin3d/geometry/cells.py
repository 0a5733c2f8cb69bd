# SPDX-License-Identifier: Apache-2.0
"""Points in the plane by the cells of a grid: neighbours in the plane become neighbours in memory."""

from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.types import Array


@dataclass(frozen=True)
class Cells:
    """Points sorted by cells, row by row of the grid; every other row runs backwards."""

    order: Array
    """(N,) int32 the points, those of one cell in their given order."""
    starts: Array
    """(rows * columns + 1,) int32: a cell's points are `order[starts[cell] : starts[cell + 1]]`."""
    columns: int
    rows: int
    side: float


@inlined
def cell_number(column, row, columns):  # type: ignore[no-untyped-def]
    """Where a cell comes in the order."""
    return row * columns + (column if row % 2 == 0 else columns - 1 - column)


@kernel
def _sort(points, corner, side, columns, starts, order):  # type: ignore[no-untyped-def]
    """Counting sort; `starts` comes with zeros."""
    numbers = np.empty(points.shape[0], np.int32)
    for p in range(points.shape[0]):
        column, row = int((points[p, 0] - corner[0]) / side), int((points[p, 1] - corner[1]) / side)
        numbers[p] = cell_number(column, row, columns)
        starts[numbers[p] + 1] += 1
    for c in range(starts.shape[0] - 1):
        starts[c + 1] += starts[c]
    filled = starts.copy()
    for p in range(points.shape[0]):
        order[filled[numbers[p]]] = p
        filled[numbers[p]] += 1


def bounds(points: Array) -> tuple[Array, tuple[float, float]]:
    """The low corner (2,) float64, and the width and height, of points (N, 2); column by column, which numpy does many times faster."""
    (left, right), (top, bottom) = ((float(column.min()), float(column.max())) for column in points.T)
    return np.array([left, top]), (right - left, bottom - top)


def cells_of(points: Array, points_per_cell: float, least_side: float = 0.0) -> Cells:
    """Cells of points (N, 2), N > 0, finite, so large that about so many fall into one, or larger."""
    corner, (width, height) = bounds(points)
    side = max(float(np.sqrt(width * height * points_per_cell / len(points))), max(width, height) / len(points), least_side)
    side = side if side > 0.0 else 1.0
    columns, rows = int(width / side) + 1, int(height / side) + 1
    starts, order = np.zeros(columns * rows + 1, np.int32), np.empty(len(points), np.int32)
    _sort(np.ascontiguousarray(points, np.float64), corner, side, columns, starts, order)
    return Cells(order, starts, columns, rows, side)
