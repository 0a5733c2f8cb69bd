# SPDX-License-Identifier: Apache-2.0
"""Arrays that grow, and the rows in them of ids that are never used again."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vitamin3d.types import Array


class GrowingArray:
    """An array whose first axis grows by doubling; `view` is the used part."""

    def __init__(self, shape: tuple[int, ...], dtype: type, fill: float) -> None:
        self._fill = fill
        self._data = self._filled((1024, *shape), dtype)
        self.size = 0

    def _filled(self, shape: tuple[int, ...], dtype: Any) -> Array:
        return np.full(shape, self._fill, dtype) if self._fill else np.zeros(shape, dtype)  # zeros cost nothing until they are used

    @property
    def view(self) -> Array:
        return self._data[: self.size]

    def resize(self, size: int) -> None:
        if size > len(self._data):
            grown = self._filled((max(size, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            grown[: self.size] = self._data[: self.size]
            self._data = grown
        self.size = max(self.size, size)

    def append(self, values: Array) -> None:
        start = self.size
        self.resize(start + len(values))
        self._data[start : self.size] = values


class Column:
    """An attribute of a class of growing arrays (`Columns`); reading it gives the used part, a view."""

    def __init__(self, shape: tuple[int, ...], dtype: type, fill: float) -> None:
        self.of_array, self._name = (shape, dtype, fill), ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: "Columns", owner: type) -> Array:
        return instance.columns[self._name].view


class Columns:
    """Has an array for each `Column` of its class."""

    def __init__(self) -> None:
        found = {name: column for name, column in vars(type(self)).items() if isinstance(column, Column)}
        self.columns = {name: GrowingArray(*column.of_array) for name, column in found.items()}


@dataclass(frozen=True)
class IdRows:
    """The rows of ids in arrays that forget some of them now and then: those of old ids in their order, then one for each newer id."""

    first_new: int = 0
    """Ids from here on have a row each, whether they ever come or not."""
    old: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    """(I,) ascending: the older ids that are not forgotten."""

    def of(self, ids: Array) -> Array:
        """(N,) rows of ids (N,), -1 where one is forgotten."""
        rows = ids - (self.first_new - len(self.old))
        is_old = ids < self.first_new
        if is_old.any():
            rows[is_old] = self._old_rows(ids[is_old])
        return np.asarray(rows)

    def _old_rows(self, ids: Array) -> Array:
        if len(self.old) == 0:
            return np.full(len(ids), -1)
        rows = np.minimum(np.searchsorted(self.old, ids), len(self.old) - 1)
        return np.where(self.old[rows] == ids, rows, -1)

    def ids(self, rows: Array) -> Array:
        """(N,) ids of rows (N,)."""
        ids = rows + (self.first_new - len(self.old))
        is_old = rows < len(self.old)
        ids[is_old] = self.old[rows[is_old]]
        return np.asarray(ids)

    def keeping(self, ids: Array) -> "IdRows":
        """After all but `ids` (I,), ascending, are forgotten: their rows are their positions. Ids beyond them are new ones."""
        return IdRows(int(ids[-1]) + 1 if len(ids) else self.first_new, ids)
